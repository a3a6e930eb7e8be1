"""Logs in and out: MCAP with ROS 2 messages, trajectory files, converters."""
