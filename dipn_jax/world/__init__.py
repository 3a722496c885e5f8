"""Objects and clutter, scenes as MJCF, and the primitives settle, push and grasp."""
