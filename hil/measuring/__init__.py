"""Measuring a network: each stage of a cycle, the losses both ways, the drives' clocks."""
