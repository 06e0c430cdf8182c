"""Runs drawn at random, each held against what must be true of every run."""
