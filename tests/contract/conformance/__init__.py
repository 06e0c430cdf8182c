"""CiA 301, 305 and 402 rule by rule, over raw frames, on every kind of bus."""
