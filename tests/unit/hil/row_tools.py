"""Rows for tests: from records, or from a few columns."""

from collections.abc import Iterable

import numpy as np

from hil.loop.samples import CycleRecord
from hil.rows.records import ROW_DTYPE, Rows, row_of


def rows_of(records: Iterable[CycleRecord]) -> Rows:
    """Packed records."""
    return np.frombuffer(b"".join(row_of(record) for record in records), ROW_DTYPE)


def plain_rows(
    count: int,
    reference: Iterable[float] | float = 0.0,
    velocity: Iterable[float] | float = 0.0,
    load: Iterable[float] | float = 0.0,
    fate: Iterable[int] | int = 0,
    statusword: Iterable[int] | int = 0x1637,
) -> Rows:
    """``count`` rows at 1 kHz from instant 0; scalars hold for every row."""
    rows = np.zeros(count, ROW_DTYPE)
    rows["certain"] = 1
    rows["sequence"] = np.arange(1, count + 1)
    rows["due_at"] = rows["woke_at"] = np.arange(count) * 1_000_000
    columns = {
        "reference_rad_s": reference,
        "velocity_rad_s": velocity,
        "load_torque_nm": load,
        "fate": fate,
        "statusword": statusword,
    }
    for name, values in columns.items():
        rows[name] = values if isinstance(values, int | float) else list(values)
    return rows
