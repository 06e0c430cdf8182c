"""The client of a servo drive: states, modes, set-points, readings, scaling (CiA 402)."""
