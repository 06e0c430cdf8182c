"""Bench files and all other files that a user writes: their models, and their errors in words."""
