"""A run from a checked bench file to drives at rest: world, axes, guards, simulated drives."""
