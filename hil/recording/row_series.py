"""Series drawn from the rows of one axis: by the path of the series a value for each row, NaN where there is
none. No line crosses a gap.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.loop.cycle_record import COMMAND_FATES, FATE_SAMPLE, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.rows.records import Rows

_LOST = COMMAND_FATES.index(CommandFate.LOST)
Line = tuple[str, NDArray[np.float64]]
"""Path below the axis, and values, (n,)."""
Drawn = tuple[str, NDArray[np.int64], NDArray[np.float64]]
"""Path below the axis, instants and values, (n,)."""
READ_SERIES: Final = frozenset(
    (
        *("speed/measured", "error/error", "torque/measured", "delay/delay"),
        *("position/measured", "position_error/error"),
    )
)
"""Series of what was read from the drive: with a gap where no reading came."""


def main_lines_of(rows: Rows, torque_scale: float) -> Iterator[Line]:
    """Speed, error, torque and delay; ``torque_scale``: of N m.

    Column by column: a copy of whole rows costs many times what is looked at.
    """
    velocity, reference = rows["velocity_rad_s"], rows["reference_rad_s"]
    read = rows["fate"] == FATE_SAMPLE
    estimated = rows["estimate_valid_at"] != NOTHING
    yield "speed/reference", reference * RPM_PER_RAD_S
    yield "speed/estimate", np.where(estimated, rows["estimate_velocity_rad_s"] * RPM_PER_RAD_S, np.nan)
    yield "speed/measured", np.where(read, velocity * RPM_PER_RAD_S, np.nan)
    yield "error/error", np.where(read, (reference - velocity) * RPM_PER_RAD_S, np.nan)
    yield "torque/command", torque_scale * rows["command_torque_nm"]
    yield "torque/load", torque_scale * rows["load_torque_nm"]
    yield "torque/measured", np.where(read, torque_scale * rows["torque_nm"], np.nan)
    yield "delay/delay", _in_us(rows["delay_ns"])


def lines_of(
    rows: Rows, torque_scale: float, offset_origin_ns: int | None, positions: bool = False
) -> Iterator[Line]:
    """All of them; ``offset_origin_ns``: that of the clock in the first row that has one.

    ``positions``: the reference is one of the position.
    """
    yield from main_lines_of(rows, torque_scale)
    if positions:
        yield from position_lines_of(rows)
    handed_at = rows["command_handed_at"]
    yield "commands/on_bus", _in_us(rows["command_on_bus_at"], handed_at)
    yield "commands/acting", _in_us(rows["command_acts_by"], handed_at)
    yield "commands/computing", _in_us(rows["compute_ns"])
    yield from _clock(rows, offset_origin_ns or 0)


def position_lines_of(rows: Rows) -> Iterator[Line]:
    """Reference and position, rad, and the error of each reading at its own instant."""
    due_at, reference = rows["due_at"], rows["reference_position_rad"]
    read, position = rows["fate"] == FATE_SAMPLE, rows["position_rad"]
    passed_s = np.where(read, rows["sampled_at"] - due_at, 0) / NS_PER_S
    yield "position/reference", reference
    yield "position/measured", np.where(read, position, np.nan)
    asked = reference + rows["reference_rad_s"] * passed_s
    yield "position_error/error", np.where(read, asked - position, np.nan)


def marks_of(rows: Rows) -> Iterator[Drawn]:
    """Points beside the lines."""
    dropped = rows.compress(rows["fate"] != FATE_SAMPLE)
    doubtful = rows.compress(rows["certain"] == 0)
    lost = rows.compress(rows["command_fate"] == _LOST)
    yield "speed/dropped", dropped["due_at"], dropped["estimate_velocity_rad_s"] * RPM_PER_RAD_S
    yield "delay/dropped", dropped["due_at"], np.zeros(dropped.size)
    at_us = np.where(doubtful["delay_ns"] == NOTHING, 0, doubtful["delay_ns"]) / NS_PER_US
    yield "delay/uncertain", doubtful["due_at"], at_us
    yield "commands/lost", lost["due_at"], np.zeros(lost.size)


def first_offset_ns(rows: Rows) -> int | None:
    """Return the drive's clock offset in the first row that has one."""
    told = rows["clock_offset_ns"][rows["clock_offset_ns"] != NOTHING]
    return int(told[0]) if told.size else None


def _in_us(instants: NDArray[np.int64], since: NDArray[np.int64] | int = 0) -> NDArray[np.float64]:
    """Durations, where they are known: ns, (n,), from ``since`` on."""
    return np.where(instants == NOTHING, np.nan, (instants - since) / NS_PER_US)


def _clock(rows: Rows, origin_ns: int) -> Iterator[Line]:
    """The offset of the drive's clock since the run began, and between what bounds it is known."""
    offset_us = _in_us(rows["clock_offset_ns"], origin_ns)
    error_us = rows["clock_error_ns"] / NS_PER_US
    yield "clock/offset", offset_us
    yield "clock/lower", offset_us - error_us
    yield "clock/upper", offset_us + error_us
