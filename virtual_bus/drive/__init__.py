"""A servo drive on it (CiA 402): firmware, current control, motor."""
