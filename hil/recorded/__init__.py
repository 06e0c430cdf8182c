"""Judge, compare, draw and show a recorded run."""
