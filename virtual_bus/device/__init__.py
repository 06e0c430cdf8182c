"""A CANopen device without I/O (CiA 301)."""
