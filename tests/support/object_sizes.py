"""Sizes of one object of each class, as tests of contacts use them."""

SIZES = {
    "cuboid": (0.06, 0.05, 0.04),
    "cylinder": (0.048, 0.05, 0.048),
    "half_cylinder": (0.05, 0.05, 0.025),
    "triangular_prism": (0.06, 0.05, 0.04),
    "concave": (0.05, 0.05, 0.09),
}
"""Metres, bounding box."""
