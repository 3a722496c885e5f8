"""How the results in docs are made: one script per page, with a list of commands and the code that writes the page."""

import dipn_jax  # noqa: F401  settings that must be made before JAX is imported
