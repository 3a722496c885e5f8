"""Evaluations of single grasps and of GN's scores."""
