"""Predictions, grasps, whole policies and the report: `dipn-eval`."""

import dipn_jax  # noqa: F401  settings that must be made before JAX is imported
