"""Fault plans, and what strikes frames and devices by them."""
