"""What a run told of each cycle, in one form, whichever layout its rows have.

This is the one place of the witness that knows a row's columns.
"""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import Duration
from servobench.hil.loop.cycle_record import COMMAND_FATES
from servobench.hil.rows.records import ROW_DTYPE, Rows

NO_INSTANT: Final = -(2**63)
"""Stands for an instant that there is not."""

USED, LOST, LATE, STALE, MISSED = range(5)
"""``fate`` of a reading."""
TORQUE_UNIT_NM: Final = 0.002
"""6071h counts thousandths of the rated torque, 2 N m of the motor of [Ling2012]."""
NOT_MEASURED, ACTING, COMMAND_LOST, NOT_IDENTIFIABLE = range(4)
NOT_SENT: Final = [fate.value for fate in COMMAND_FATES].index("not sent")
"""``command_fate``."""

_INSTANTS = (
    "due_at",
    "woke_at",
    "sync_handed_at",
    "sync_on_bus_at",
    "sampled_at",
    "received_at",
    "device_time_ns",
    "command_handed_at",
    "command_on_bus_at",
    "command_acts_after",
    "command_acts_by",
)
_WHOLE = (
    "sequence",
    "axis",
    "fate",
    "certain",
    "delay_ns",
    "sampled_at_error_ns",
    "command_fate",
    "command_raw",
)
TOLD_DTYPE: Final = np.dtype(
    [(name, np.int64) for name in (*_WHOLE, *_INSTANTS)] + [("velocity_rad_s", np.float64)]
)

Told = NDArray[np.void]
"""(n,) of TOLD_DTYPE, one axis, in order of ``sequence``: the number of the planned cycle, from 1."""


def each_row(told: Told) -> Iterator[dict[str, Any]]:
    """The rows by their columns, in numbers of Python: a field of a row of numpy takes ten times as long."""
    names = told.dtype.names or ()
    for values in told.tolist():
        yield dict(zip(names, values, strict=True))


OLD_LAYOUT: Final = "sync_sent_at" in (ROW_DTYPE.names or ())
"""Rows that number SYNCs, leave missed cycles out and know of no echo, no doubt and no way of a command."""

READING_IS_A_SET: Final = OLD_LAYOUT
"""A reading is complete with the last TPDO of its SYNC; else the TPDO with the speed is the reading."""


def told_by(rows: Rows, axis: int, period: Duration) -> Told:
    """What ``rows`` tell of one axis."""
    own = np.sort(rows[rows["axis"] == axis], order="due_at")
    return _from_old(own, period) if OLD_LAYOUT else _from_new(own)


def _from_new(own: Rows) -> Told:
    told = np.empty(own.size, TOLD_DTYPE)
    for name in TOLD_DTYPE.names or ():
        told[name] = own[name]
    return told


def _from_old(own: Rows, period: Duration) -> Told:
    """Nothing was in doubt there, and every command acted when it was meant to."""
    told = np.full(own.size, NO_INSTANT, np.int64).astype(TOLD_DTYPE)
    if not own.size:
        return told
    used = own["fate"] == USED
    told["sequence"] = 1 + np.rint((own["due_at"] - own["due_at"][0]) / period)
    for name in ("axis", "due_at", "woke_at", "fate", "delay_ns", "velocity_rad_s", "sampled_at_error_ns"):
        told[name] = own[name]
    told["certain"] = 1
    told["sync_handed_at"] = own["sync_sent_at"]
    told["sampled_at"] = np.where(used, own["observation_at"], NO_INSTANT)
    told["device_time_ns"] = own["device_time_ns"]
    told["received_at"] = np.where(used, own["received_at"], NO_INSTANT)
    sent = own["command_sent_at"] >= 0
    told["command_handed_at"] = np.where(sent, own["command_sent_at"], NO_INSTANT)
    told["command_raw"] = np.rint(own["command_torque_nm"] / TORQUE_UNIT_NM)
    told["command_fate"] = np.where(sent, ACTING, NOT_MEASURED)
    for name in ("command_acts_after", "command_acts_by"):
        told[name] = np.where(sent, own["command_effective_at"], NO_INSTANT)
    return told
