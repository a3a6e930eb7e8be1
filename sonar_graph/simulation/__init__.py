"""Truth and sensor readings; shares no code with the models that it judges."""
