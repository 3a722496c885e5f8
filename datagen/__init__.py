"""Episodes by the thousand: `dipn-datagen`."""

import dipn_jax  # noqa: F401  settings that must be made before JAX is imported
