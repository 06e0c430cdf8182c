"""Series drawn from the rows of one axis: instants and values by the path of the series."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.loop.samples import CommandFate
from servobench.hil.reviewing.envelope import Points
from servobench.hil.rows.records import COMMAND_FATES, FATE_SAMPLE, NOTHING, Rows

_LOST = COMMAND_FATES.index(CommandFate.LOST)
Drawn = tuple[str, NDArray[np.int64], NDArray[np.float64]]
"""Path below the axis, instants and values, (n,)."""
READ_SERIES: Final = frozenset(
    (
        *("speed/measured", "error/error", "torque/measured", "delay/delay"),
        *("position/measured", "position_error/error"),
    )
)
"""Series of what was read from the drive: with a gap where no reading came."""


def main_lines_of(rows: Rows, torque_scale: float) -> Iterator[Drawn]:
    """Speed, error, torque and delay; ``torque_scale``: of N m.

    Column by column: a copy of whole rows costs many times what is looked at.
    """
    due_at, velocity, reference = rows["due_at"], rows["velocity_rad_s"], rows["reference_rad_s"]
    read = rows["fate"] == FATE_SAMPLE
    known, came = rows["estimate_valid_at"] != NOTHING, rows["delay_ns"] != NOTHING
    yield "speed/reference", due_at, reference * RPM_PER_RAD_S
    yield "speed/estimate", due_at[known], rows["estimate_velocity_rad_s"][known] * RPM_PER_RAD_S
    yield "speed/measured", *_where(read, due_at, velocity * RPM_PER_RAD_S)
    yield "error/error", *_where(read, due_at, (reference - velocity) * RPM_PER_RAD_S)
    yield "torque/command", due_at, torque_scale * rows["command_torque_nm"]
    yield "torque/load", due_at, torque_scale * rows["load_torque_nm"]
    yield "torque/measured", *_where(read, due_at, torque_scale * rows["torque_nm"])
    yield "delay/delay", *_where(came, due_at, rows["delay_ns"] / NS_PER_US)


def _where(known: NDArray[np.bool_], due_at: NDArray[np.int64], values: NDArray[np.float64]) -> Points:
    """What is known, and no number where it ceases to be: no line crosses a gap."""
    ceases = ~known & np.append(True, known[:-1])
    drawn = known | ceases
    return due_at[drawn], np.where(known, values, np.nan)[drawn]


def lines_of(
    rows: Rows, torque_scale: float, offset_origin_ns: int | None, positions: bool = False
) -> Iterator[Drawn]:
    """All of them; ``offset_origin_ns``: that of the clock in the first row that has one.

    ``positions``: the reference is one of the position.
    """
    yield from main_lines_of(rows, torque_scale)
    if positions:
        yield from position_lines_of(rows)
    yield from _commands(rows)
    if offset_origin_ns is not None:
        yield from _clock(rows, offset_origin_ns)


def position_lines_of(rows: Rows) -> Iterator[Drawn]:
    """Reference and position, rad, and the error of each reading at its own instant."""
    due_at, reference = rows["due_at"], rows["reference_position_rad"]
    read, position = rows["fate"] == FATE_SAMPLE, rows["position_rad"]
    passed_s = np.where(read, rows["sampled_at"] - due_at, 0) / NS_PER_S
    yield "position/reference", due_at, reference
    yield "position/measured", *_where(read, due_at, position)
    asked = reference + rows["reference_rad_s"] * passed_s
    yield "position_error/error", *_where(read, due_at, asked - position)


def marks_of(rows: Rows) -> Iterator[Drawn]:
    """Points beside the lines."""
    dropped = rows[rows["fate"] != FATE_SAMPLE]
    doubtful = rows[rows["certain"] == 0]
    lost = rows[rows["command_fate"] == _LOST]
    yield "speed/dropped", dropped["due_at"], dropped["estimate_velocity_rad_s"] * RPM_PER_RAD_S
    yield "delay/dropped", dropped["due_at"], np.zeros(dropped.size)
    at_us = np.where(doubtful["delay_ns"] == NOTHING, 0, doubtful["delay_ns"]) / NS_PER_US
    yield "delay/uncertain", doubtful["due_at"], at_us
    yield "commands/lost", lost["due_at"], np.zeros(lost.size)


def first_offset_ns(rows: Rows) -> int | None:
    """Return the drive's clock offset in the first row that has one."""
    told = rows["clock_offset_ns"][rows["clock_offset_ns"] != NOTHING]
    return int(told[0]) if told.size else None


def _commands(rows: Rows) -> Iterator[Drawn]:
    """From handing a command over until it was on the bus, and until it acted at the latest."""
    due_at, handed_at, compute = rows["due_at"], rows["command_handed_at"], rows["compute_ns"]
    for series, name in (("on_bus", "command_on_bus_at"), ("acting", "command_acts_by")):
        instant = rows[name]
        known = instant != NOTHING
        yield f"commands/{series}", due_at[known], (instant[known] - handed_at[known]) / NS_PER_US
    computed = compute != NOTHING
    yield "commands/computing", due_at[computed], compute[computed] / NS_PER_US


def _clock(rows: Rows, origin_ns: int) -> Iterator[Drawn]:
    """The offset of the drive's clock since the run began, and between what bounds it is known."""
    told = rows["clock_offset_ns"] != NOTHING
    due_at = rows["due_at"][told]
    offset_us = (rows["clock_offset_ns"][told] - origin_ns) / NS_PER_US
    error_us = rows["clock_error_ns"][told] / NS_PER_US
    yield "clock/offset", due_at, offset_us
    yield "clock/lower", due_at, offset_us - error_us
    yield "clock/upper", due_at, offset_us + error_us
