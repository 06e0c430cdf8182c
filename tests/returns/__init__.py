"""Drives that leave their commands for a while and come back, drawn."""
