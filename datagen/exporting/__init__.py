"""Data sets written in formats of other tools."""
