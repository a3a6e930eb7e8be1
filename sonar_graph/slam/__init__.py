"""Landmark SLAM by incremental smoothing: models, factors, the iSAM2 estimator."""
