"""The rows of a record: their layout, the plan that they go by, and what they tell of a run."""

from servobench.drivers.compiled import use_fresh

use_fresh()
