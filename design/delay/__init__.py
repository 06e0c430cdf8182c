"""Loops with a constant delay: norms, responses, LMIs, certificates."""
