"""Converters of data sets, sonar recordings and ROS bags, each a function."""

# fmt: off
from sonar_graph.logs.convert.akit import read_akit
from sonar_graph.logs.convert.csv_log import read_csv, with_truth
from sonar_graph.logs.convert.csv_template import csv_template
from sonar_graph.logs.convert.didson_aris import convert_aris, convert_didson
from sonar_graph.logs.convert.mrclam import read_mrclam
from sonar_graph.logs.convert.oculus import convert_oculus
from sonar_graph.logs.convert.planar import read_dlr, read_victoria_park
from sonar_graph.logs.convert.rosbag import BagConversion, convert_rosbag
from sonar_graph.logs.convert.sonar_file import SonarConversion
from sonar_graph.logs.convert.stpere import read_stpere

__all__ = [
    "BagConversion", "SonarConversion", "convert_aris", "convert_didson", "convert_oculus", "convert_rosbag",
    "csv_template", "read_akit", "read_csv", "read_dlr", "read_mrclam", "read_stpere", "read_victoria_park",
    "with_truth",
]
