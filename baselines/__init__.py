"""Estimators to compare with: ordinary users of the contract in `sonar_graph.estimator`."""
