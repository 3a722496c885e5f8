"""Predictions, grasps, whole policies and the report: `dipn-eval`."""
