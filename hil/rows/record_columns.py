"""The columns of records.arrow: type, unit, codes and meaning of each. docs/recording.md shows them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from drivers.errors import BadInput
from hil.loop.context import CHANNELS_MAX
from hil.rows.records import CAUSES, COMMAND_FATES, NOTHING

FORMAT: Final = "2"
"""Version of the run's folder as docs/recording.md describes it; counts up when a reader must know."""


def refuse_later_format(metadata: Mapping[str, str], source: Path) -> None:
    """Raises BadInput for a recording whose format counts higher than FORMAT; earlier ones are read."""
    told = metadata.get("format", FORMAT)
    if not told.isdigit() or int(told) > int(FORMAT):
        expected = f"a recording of format {FORMAT} or earlier"
        raise BadInput(
            str(source), "format", told, expected, "read it with the servobench that wrote it, or later"
        )


class Column(NamedTuple):
    """One column."""

    name: str
    kind: str
    """Arrow's name of its type."""
    unit: str
    """Empty for a plain number."""
    meaning: str
    codes: tuple[str, ...] = ()
    """What its numbers stand for, from 0 on."""
    none: int = NOTHING
    """What stands for nothing in a packed row, beside NOTHING."""

    @property
    def is_instant(self) -> bool:
        """It counts from the first cycle, and in a packed row from the bench clock's origin."""
        return self.unit == RUN_TIME

    @property
    def metadata(self) -> dict[str, str]:
        """Of its field in the file."""
        told = {"meaning": self.meaning}
        if self.unit:
            told["unit"] = self.unit
        if self.codes:
            told["codes"] = json.dumps(dict(enumerate(self.codes)))
        return told


RUN_TIME: Final = "ns since the first cycle"


def _instant(name: str, meaning: str, none: int = NOTHING) -> Column:
    return Column(name, "int64", RUN_TIME, meaning, none=none)


def _number(name: str, unit: str, meaning: str) -> Column:
    return Column(name, "float64", unit, meaning)


_NEVER_TOLD: Final = -1
"""In place of what a drive has not told yet (drivers.cia402.readings)."""

COLUMNS: Final = (
    Column("sequence", "int64", "", "number of the planned cycle, from 1"),
    Column("axis", "int16", "", "place of the axis in the list 'axes' of the file's metadata"),
    _instant("due_at", "the tick of the cycle"),
    _instant("woke_at", "when the host came for it; null if it did not"),
    _instant("sync_handed_at", "when its SYNC was handed to the bus; null without SYNC"),
    _instant("sync_on_bus_at", "end of its SYNC on the bus; null if it is not known to have come there"),
    Column(
        "fate",
        "int8",
        "",
        "what came of its reading",
        ("sample", *[cause.value for cause in CAUSES]),
    ),
    Column("certain", "bool", "", "whether the data decide which SYNC the reading answers"),
    _instant("sampled_at", "end of that SYNC at the drive; null for a dropout, as all of the reading"),
    Column("sampled_at_error_ns", "int64", "ns", "half the width of the interval that holds sampled_at"),
    _number("velocity_rad_s", "rad/s", "measured speed"),
    Column("device_time_ns", "int64", "ns on the drive's clock", "the drive's own stamp of the sample"),
    _instant("received_at", "bus stamp of the frame that carries the speed"),
    _number("position_rad", "rad", "position, carried on by the speed since it was told"),
    _instant("position_told_at", "bus stamp of the frame that told the position", _NEVER_TOLD),
    _number("torque_nm", "N m", "measured torque as last told"),
    _instant("torque_told_at", "bus stamp of the frame that told the torque", _NEVER_TOLD),
    Column("statusword", "int64", "", "object 6041h as last told", none=_NEVER_TOLD),
    _instant("status_told_at", "bus stamp of the frame that told the statusword", _NEVER_TOLD),
    Column("delay_ns", "int64", "ns", "sampled to received, of late readings too; null if none came"),
    _number("estimate_position_rad", "rad", "the state that the controller was given"),
    _number("estimate_velocity_rad_s", "rad/s", "the state that the controller was given"),
    _number("estimate_torque_nm", "N m", "the state that the controller was given"),
    _instant("estimate_valid_at", "for when that state holds"),
    Column("estimate_sequence", "int64", "", "cycle of the sample that it rests on; 0 before the first"),
    _number("reference_rad_s", "rad/s", "speed that was asked for; of a position its rate, null of a torque"),
    _number("load_torque_nm", "N m", "load that was asked for; positive opposes positive speed"),
    _number("command_torque_nm", "N m", "torque set-point, after the limits"),
    _instant("command_effective_at", "when it was meant to act"),
    _instant("command_expires_at", "when it was worth nothing any more"),
    Column("command_raw", "int64", "the unit of 6071h, 60FFh or 607Ah", "the set-point as it was sent"),
    _instant("command_handed_at", "when it was handed to the bus; null if it was not sent"),
    _instant("command_on_bus_at", "end of its frame on the bus; null if that is not known"),
    Column(
        "command_fate",
        "int8",
        "",
        "what became of the command behind the bus",
        tuple(fate.value for fate in COMMAND_FATES),
    ),
    _instant("command_acts_after", "the latest instant known at which it did not act yet"),
    _instant("command_acts_by", "the earliest instant known at which it acted"),
    _instant("clock_offset_ns", "run time minus the drive's clock, by the map of that clock"),
    Column("clock_error_ns", "int64", "ns", "error of an instant that this map places"),
    Column("compute_ns", "int64", "ns", "what compensator and controller took, by the host's own clock"),
    *(
        _number(f"channel_{number}", "", f"what the controller told as number {number} of its channels")
        for number in range(CHANNELS_MAX)
    ),
    _number("reference_position_rad", "rad", "position that was asked for; null of another reference"),
    _number("reference_torque_nm", "N m", "torque that was asked for; null of another reference"),
    _number("command_speed_rad_s", "rad/s", "speed set-point, after the limits; null of another command"),
    _number("command_position_rad", "rad", "position set-point, after the limits; null of another command"),
)
"""In the order of :data:`hil.rows.records.LAYOUT`."""

CALIBRATING, RUN, STOPPING = PHASES = ("calibrating", "run", "stopping")
PHASE_COLUMN: Final = Column("phase", "string", "", "in which phase of the bench the row was taken", PHASES)
