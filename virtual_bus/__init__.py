"""The simulated world: bus, faults, devices, drives."""

from drivers.compiled import use_fresh

use_fresh()
