"""The simulated world: bus, faults, devices, drives."""

from servobench.drivers.compiled import use_fresh

use_fresh()
