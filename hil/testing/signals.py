"""References and loads given as functions of time: evaluated for each cycle, before a run."""

from collections.abc import Callable, Mapping
from functools import cache
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.references import COLUMNS, TIME

_numbers: Final = count(1)


def with_signals(bench: Bench, signals: Mapping[str, Callable[[float], float]]) -> Bench:
    """Return ``bench`` with files in place of the references and loads that ``signals`` names.

    A key is ``reference.AXIS.COLUMN`` or ``load.AXIS.COLUMN``, its columns those of a signal file; a function
    is given the time since the run began, s. Between two cycles the values lie on a straight line. Raises
    BadInput; exceptions of a function pass through.
    """
    config = bench.config
    period_s = config.loop.period / NS_PER_S
    times = np.arange(round(config.bench.duration_s / period_s) + 1) * period_s
    changes = {}
    for key, signal in signals.items():
        table, axis, column = (*key.split("."), "", "")[:3]
        if table not in ("reference", "load") or key.count(".") != 2 or column not in COLUMNS:
            expected = f"reference.AXIS.COLUMN or load.AXIS.COLUMN, of the columns {', '.join(COLUMNS)}"
            raise BadInput("signals", key, key, expected)
        path = Path(_scratch().name) / f"{next(_numbers)}.parquet"
        levels = [float(signal(time)) for time in times.tolist()]
        parquet.write_table(pa.table({TIME: times, column: levels}), path)
        changes[f"{table}.{axis}"] = [{"kind": "file", "path": str(path)}]
    return bench.changed(changes)


@cache
def _scratch() -> "TemporaryDirectory[str]":
    """Make a folder that vanishes with the process."""
    return TemporaryDirectory(prefix="servobench-")
