"""The rows of a recording: their layout, the plan behind them, and derived facts about a run."""

from servobench.drivers.compiled import use_fresh

use_fresh()
