"""The control loop and its axes: ticks, SYNCs, readings placed in time, safety. Knows no file."""
