"""Evaluate predictions, grasps and whole policies, and write the report: `dipn-eval`."""
