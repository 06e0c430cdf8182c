"""``[[reference.NAME]]`` and ``[[load.NAME]]`` of a bench file: an axis' motion, and the load on its shaft.

A reference is a speed, a position or a torque. Every entry has one of the keys ``speed_rpm``,
``position_rad`` and ``torque_nm``, or of a sine's amplitudes, and all entries of an axis have the same. A
position counts from that of the shaft when the run begins.

A signal over time stands in a file, CSV or Parquet: columns by name, with the unit at the end: ``time_s``,
which rises, and one of ``speed_rpm``, ``speed_rad_s``, ``position_rad`` and ``torque_nm``; other columns are
left alone.
"""

import math
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from servobench.drivers.bounded_file import NamedBy, read_bytes
from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.quantities import (
    Angle,
    Frequency,
    SignedSpeed,
    SignedTorque,
    Speed,
    TimeConstant,
    Torque,
)
from servobench.hil.loop.scenario import LevelStep, Quantity, Ramp, Repeated, SCurve, Segment, Sine, Table

TIME: Final = "time_s"
COLUMNS: Final = {
    "speed_rpm": (Quantity.SPEED, RAD_S_PER_RPM),
    "speed_rad_s": (Quantity.SPEED, 1.0),
    "position_rad": (Quantity.POSITION, 1.0),
    "torque_nm": (Quantity.TORQUE, 1.0),
}
"""Quantity of each, and its unit in SI."""
ROWS_MAX: Final = 20_000_000
"""Five hours and a half at 1 kHz: 320 MB while it runs."""


@dataclass(frozen=True, slots=True)
class Signal:
    """The contents of a file, in SI units."""

    quantity: Quantity
    times_s: bytes
    """(n,), doubles, little-endian: as the loop looks them up
    (:class:`servobench.hil.loop.scenario.Table`)."""
    levels: bytes
    """(n,), likewise."""
    points: int
    last_s: float
    least: float
    peak: float
    """Largest magnitude."""
    rate: float
    """Largest change per second between two points."""
    gained: float
    """From the first point to the last; 0 for a speed or a torque, which have no place to go on from."""


def load_signal(path: Path, named_by: NamedBy | None = None) -> Signal:
    """Load the signal in a file; ``named_by``: its source. Raises BadInput, naming file, column and value."""
    size_bytes = path.stat().st_size if path.is_file() else 0  # rows are bounded, not bytes
    content = read_bytes(path, "signal file", named_by, size_bytes)
    key = path, blake2b(content, digest_size=16).digest()
    if key not in _parsed:
        while len(_parsed) >= _PARSED_MAX:
            del _parsed[next(iter(_parsed))]
        _parsed[key] = _load(path, content)
    return _parsed[key]


_PARSED_MAX: Final = 8
"""A bench names one or two; sixteen bytes per row stay in memory."""
_parsed: dict[tuple[Path, bytes], Signal] = {}
"""Signals by content: two edits within a tick of the file system's clock leave the same time."""


def _load(path: Path, content: bytes) -> Signal:
    table = _read(path, content)
    names = [name for name in COLUMNS if name in table.column_names]
    if TIME not in table.column_names or len(names) != 1:
        expected = f"{TIME} and one of {', '.join(COLUMNS)}"
        raise BadInput(str(path), "columns", ", ".join(table.column_names), expected)
    if not 1 <= table.num_rows <= ROWS_MAX:
        raise BadInput(str(path), "rows", table.num_rows, f"1 to {ROWS_MAX}")
    times = _numbers(table, TIME, path)
    quantity, unit = COLUMNS[names[0]]
    levels = _numbers(table, names[0], path) * unit
    falls = np.flatnonzero(np.diff(times) <= 0.0)
    if falls.size:
        place = int(falls[0]) + 1
        expected = f"more than the row before it, {times[place - 1]:g}"
        raise BadInput(str(path), f"{TIME}[{place}]", float(times[place]), expected)
    rates = np.abs(np.diff(levels)) / np.diff(times)
    return Signal(
        quantity,
        times.astype("<f8").tobytes(),
        levels.astype("<f8").tobytes(),
        points=len(times),
        last_s=float(times[-1]),
        least=float(levels.min()),
        peak=float(np.abs(levels).max()),
        rate=float(rates.max(initial=0.0)),
        gained=float(levels[-1] - levels[0]) if quantity is Quantity.POSITION else 0.0,
    )


def _read(path: Path, content: bytes) -> Any:
    import pyarrow as pa
    from pyarrow import csv, parquet

    if path.suffix not in (".csv", ".parquet"):
        raise BadInput(str(path), "path", path.suffix, "a file named .csv or .parquet")
    try:
        file = pa.BufferReader(content)
        return csv.read_csv(file) if path.suffix == ".csv" else parquet.read_table(file)
    except (OSError, pa.ArrowException) as error:
        kind = "CSV with a line of column names" if path.suffix == ".csv" else "Parquet"
        raise BadInput(str(path), "file", str(error).splitlines()[0], kind) from None


def _numbers(table: Any, name: str, path: Path) -> NDArray[np.float64]:
    try:
        numbers: NDArray[np.float64] = np.array(table[name].cast("float64").to_numpy(), np.float64)
    except ValueError as error:  # which pyarrow's own are derived from
        raise BadInput(str(path), name, str(error).splitlines()[0], "numbers") from None
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if wrong.size:
        place = int(wrong[0])
        raise BadInput(str(path), f"{name}[{place}]", float(numbers[place]), "a finite number in every row")
    return numbers


_KEYS = {
    Quantity.SPEED: ("speed_rpm", "amplitude_rpm"),
    Quantity.POSITION: ("position_rad", "amplitude_rad"),
    Quantity.TORQUE: ("torque_nm", "amplitude_nm"),
}
UNITS = {Quantity.SPEED: "r/min", Quantity.POSITION: "rad", Quantity.TORQUE: "N m"}
"""Units shown to the user."""


class _Entry(Section):
    """One entry: a kind, an instant, and a level in one of three quantities."""

    at_s: float = Field(ge=0, description="the time since the run began, s")

    @property
    def told(self) -> list[tuple[Quantity, str]]:
        """The quantities given, with their keys; a valid entry has one."""
        return [
            (quantity, key)
            for quantity, keys in _KEYS.items()
            for key in keys
            if getattr(self, key, None) is not None
        ]

    @property
    def keys(self) -> list[str]:
        """Keys of which it must have exactly one."""
        return [key for keys in _KEYS.values() for key in keys if key in type(self).model_fields]

    @property
    def quantity(self) -> Quantity:
        """Quantity of its key."""
        return self.told[0][0]

    @property
    def level(self) -> float:
        """Level as in the file, in the unit of its key."""
        value: float = getattr(self, self.told[0][1])
        return value

    @property
    def level_si(self) -> float:
        """Level in rad/s, rad or N m."""
        return self.level * RAD_S_PER_RPM if self.quantity is Quantity.SPEED else self.level

    @property
    def level_text(self) -> str:
        """Level with its unit, for the events of a run."""
        return f"{self.level:g} {UNITS[self.quantity]}"


class StepReference(_Entry):
    """From ``at_s`` on: this level."""

    kind: Literal["step"]
    speed_rpm: SignedSpeed | None = Field(default=None, description="the speed to go to, r/min")
    position_rad: Angle | None = Field(default=None, description="the position to go to, rad")
    torque_nm: SignedTorque | None = Field(default=None, description="the torque to go to, N m")

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        return f"step to {self.level_text}"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        return LevelStep(self.at_s, self.level_si)


class RampReference(_Entry):
    """From ``at_s`` on: to this level within ``over_s``, then stay.

    ``ramp`` goes at a constant rate, ``s_curve`` by a polynomial of the fifth degree, whose rate and
    acceleration are 0 at both ends and whose rate peaks at 15/8 of the ramp's.
    """

    kind: Literal["ramp", "s_curve"]
    speed_rpm: SignedSpeed | None = Field(default=None, description="the speed to go to, r/min")
    position_rad: Angle | None = Field(default=None, description="the position to go to, rad")
    torque_nm: SignedTorque | None = Field(default=None, description="the torque to go to, N m")
    over_s: TimeConstant = Field(description="how long it takes, s")

    @property
    def steepest(self) -> float:
        """Largest rate, of the mean one."""
        return 1.0 if self.kind == "ramp" else 1.875

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        name = "ramp" if self.kind == "ramp" else "S-curve"
        return f"{name} to {self.level_text} over {self.over_s:g} s"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        return (Ramp if self.kind == "ramp" else SCurve)(self.at_s, self.level_si, self.over_s)


class SineReference(_Entry):
    """From ``at_s`` on: swing about the level of that moment."""

    kind: Literal["sine"]
    amplitude_rpm: Speed | None = Field(default=None, description="the amplitude of the swing, r/min")
    amplitude_rad: Angle | None = Field(default=None, description="the amplitude of the swing, rad")
    amplitude_nm: Torque | None = Field(default=None, description="the amplitude of the swing, N m")
    frequency_hz: Frequency = Field(description="the frequency of the swing, Hz")

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        return f"sine of {self.level_text} at {self.frequency_hz:g} Hz"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        return Sine(self.at_s, self.level_si, self.frequency_hz)


class SignalFile(_Entry):
    """From ``at_s`` on: the signal in a file, whose time 0 lies there
    (:mod:`servobench.hil.configuration.references`).

    As a load it holds torques, positive against positive speed, and is the only entry.
    """

    kind: Literal["file"]
    at_s: float = Field(default=0.0, ge=0, description="the time since the run began, s")
    path: str = Field(description="a CSV or Parquet file with time_s and, say, speed_rpm")
    between: Literal["interpolated", "held"] = "interpolated"
    """The signal between two rows."""
    repeats: bool = False
    """Begin anew after the last row, at the instant of that row: a position where it has come to,
    so that a cam goes on; a speed or torque as in the first row."""

    @property
    def signal(self) -> Signal:
        """The signal in the file. Raises BadInput."""
        return load_signal(Path(self.path))

    @property
    def told(self) -> list[tuple[Quantity, str]]:
        """Quantity and key of its column."""
        return [(self.signal.quantity, "path")]

    @property
    def level(self) -> float:
        """The largest magnitude, in the unit of the other entries."""
        return self.signal.peak * self._per_unit

    @property
    def rate(self) -> float:
        """The largest change per second, likewise; a held signal jumps, which does not count."""
        return 0.0 if self.between == "held" else self.signal.rate * self._per_unit

    @property
    def ends_s(self) -> float:
        """When its last row comes, s; the first time if it repeats."""
        return self.at_s + self.signal.last_s

    @property
    def _per_unit(self) -> float:
        return 1.0 / RAD_S_PER_RPM if self.quantity is Quantity.SPEED else 1.0

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        again = ", over and over" if self.repeats else ""
        return f"{self.quantity.value} of {Path(self.path).name}, {self.signal.points} points{again}"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        signal = self.signal
        table = Table(self.at_s, signal.times_s, signal.levels, self.between == "held")
        if not self.repeats:
            return table
        return Repeated(self.at_s, table, signal.last_s, signal.gained)


Reference = Annotated[StepReference | RampReference | SineReference | SignalFile, Field(discriminator="kind")]


class LoadStep(Section):
    """From ``at_s`` on: this load torque; a positive one opposes positive speed."""

    kind: Literal["step"] = "step"
    at_s: float = Field(ge=0, description="the time since the run began, s")
    torque_nm: SignedTorque = Field(description="the load torque, N m")

    @property
    def level(self) -> float:
        """N m."""
        return self.torque_nm

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        return f"torque {self.torque_nm:g} N m"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        return LevelStep(self.at_s, self.torque_nm)


Load = Annotated[LoadStep | SignalFile, Field(discriminator="kind")]


def peak_level(profile: tuple[Reference, ...]) -> float:
    """Return the largest magnitude in ``profile``, in the unit of the file."""
    peak = level = 0.0
    for entry in profile:
        level = level + entry.level if isinstance(entry, SineReference) else abs(entry.level)
        peak = max(peak, level)
    return peak


def peak_rate(profile: tuple[Reference, ...]) -> float:
    """Return the largest magnitude of its change per second, in the unit of the file; a step has none."""
    peak = before = swing = 0.0
    for entry in profile:
        if isinstance(entry, SineReference):
            swing += entry.level
            peak = max(peak, math.tau * entry.frequency_hz * entry.level)
            continue
        if isinstance(entry, RampReference):
            peak = max(peak, entry.steepest * (abs(entry.level - before) + swing) / entry.over_s)
        elif isinstance(entry, SignalFile):
            peak = max(peak, entry.rate)
        before, swing = entry.level, 0.0
    return peak
