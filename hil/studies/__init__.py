"""Computations beside the bench: current loops, speed loops, and the papers' figures."""
