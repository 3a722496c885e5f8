"""Candidate actions, Alg. 2 of the paper, and the methods that decide."""
