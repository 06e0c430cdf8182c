"""The control loop and its axes: ticks, SYNCs, readings placed in time, safety. Knows no file."""

from servobench.drivers.compiled import use_fresh

use_fresh()
