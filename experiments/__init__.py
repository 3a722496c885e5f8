"""How the results in docs are made: one script a page, a list of commands and what is drawn from their results."""

import dipn_jax  # noqa: F401  settings that must be made before JAX is imported
