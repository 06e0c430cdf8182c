"""Frames in and out of a bus: adapters, links, stamps."""
