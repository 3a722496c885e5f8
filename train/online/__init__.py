"""Trainings that act: they try grasps and pushes on tables, and learn from what comes of them."""
