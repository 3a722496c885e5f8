"""What the project costs, as ratios of two things measured side by side: `python -m benchmarks`."""

import dipn_jax  # noqa: F401  settings that must be made before JAX is imported
