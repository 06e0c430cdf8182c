"""Controllers and compensators, by which the loop computes its commands."""

from servobench.drivers.compiled import use_fresh

use_fresh()
