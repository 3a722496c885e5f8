"""One short loop and what it trains: `dipn-train`."""

import dipn_jax  # noqa: F401  settings that must be made before JAX is imported
