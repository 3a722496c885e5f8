"""Evaluations that several workers share: who evaluates what, their parts, and how these become one."""
