"""Evaluations of predicted pushes."""
