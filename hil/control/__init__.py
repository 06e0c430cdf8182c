"""Controllers and compensators: what the loop computes its commands with."""

from servobench.drivers.compiled import use_fresh

use_fresh()
