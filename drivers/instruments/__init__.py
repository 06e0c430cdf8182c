"""Dynamometers on a serial line."""
