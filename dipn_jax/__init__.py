"""Push and grasp episodes, DIPN and GN, and clutter clearing in JAX and MuJoCo.

The library: pure functions over frozen pytrees. `datagen`, `train` and `eval` are its three commands.
"""
