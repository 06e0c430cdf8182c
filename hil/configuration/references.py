"""``[[reference.NAME]]`` and ``[[load.NAME]]`` of a bench file: an axis' motion, and the load on its shaft.

A reference is a speed, a position or a torque.

Every entry has one of the keys ``speed_rpm``, ``position_rad`` and ``torque_nm``, or of a sine's amplitudes,
and all entries of an axis have the same. A position counts from that of the shaft when the run begins.
"""

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

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
from servobench.hil.configuration.signal_file import Signal, load_signal
from servobench.hil.loop.scenario import LevelStep, Quantity, Ramp, Segment, Sine, Table

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
    """From ``at_s`` on: to this level at a constant rate within ``over_s``, then stay."""

    kind: Literal["ramp"]
    speed_rpm: SignedSpeed | None = Field(default=None, description="the speed to go to, r/min")
    position_rad: Angle | None = Field(default=None, description="the position to go to, rad")
    torque_nm: SignedTorque | None = Field(default=None, description="the torque to go to, N m")
    over_s: TimeConstant = Field(description="how long the ramp takes, s")

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        return f"ramp to {self.level_text} over {self.over_s:g} s"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        return Ramp(self.at_s, self.level_si, self.over_s)


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
    (:mod:`servobench.hil.configuration.signal_file`).

    As a load it holds torques, positive against positive speed, and is the only entry.
    """

    kind: Literal["file"]
    at_s: float = Field(default=0.0, ge=0, description="the time since the run began, s")
    path: str = Field(description="a CSV or Parquet file with time_s and, say, speed_rpm")
    between: Literal["interpolated", "held"] = "interpolated"
    """The signal between two rows."""

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
        """When its last row comes, s."""
        return self.at_s + self.signal.last_s

    @property
    def _per_unit(self) -> float:
        return 1.0 / RAD_S_PER_RPM if self.quantity is Quantity.SPEED else 1.0

    def describe(self) -> str:
        """Describe it, for the events of a run."""
        return f"{self.quantity.value} of {Path(self.path).name}, {self.signal.points} points"

    def segment(self) -> Segment:
        """Return the segment for the loop."""
        signal = self.signal
        return Table(self.at_s, signal.times_s, signal.levels, self.between == "held")


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
            peak = max(peak, (abs(entry.level - before) + swing) / entry.over_s)
        elif isinstance(entry, SignalFile):
            peak = max(peak, entry.rate)
        before, swing = entry.level, 0.0
    return peak
