"""Bench files and all others that a user writes: their models, and their errors in words."""
