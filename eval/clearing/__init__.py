"""Evaluations that clear tables."""
