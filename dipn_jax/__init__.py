"""Push and grasp episodes, DIPN and GN, and clutter clearing in JAX and MuJoCo.

The library: pure functions over frozen pytrees. `datagen`, `train` and `eval` are its three commands.
"""

import os

# XLA logs an error on every program that it finds in the compilation cache on some processors, though it runs them
# (openxla issue 44565); it reads this when JAX is first imported
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
