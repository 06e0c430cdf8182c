"""The compiled plant over a window of a recording: commands at their instants, outputs at their stamps.

The firmware reads its set-point at the ticks of its inner grid, and nothing tells where between two ticks a
command came. So a command counts in proportion in the tick that follows it, as the mean over that place: what
is told then changes smoothly with the dead time, and a sum of squares over it has no steps. For the same
reason the encoder of the twin is as fine as encoders come; the steps of the real one are noise of readings.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.design.motor import PmsmParameters
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.drive.encoder import SpeedSensing
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.set_point_path import STRAIGHT, SetPointPath

Array = NDArray[np.float64]
Instants = NDArray[np.int64]

FINEST_COUNTS: Final = 1 << 30
"""Of the twin's encoder, a turn: a step is 6 nrad."""
WARM_UP_S: Final = 0.006
"""From the start of a window to its first reading. Current loops of 150 Hz and speed filters of 200 Hz have
forgotten how they began, to 1 in 1000, after it."""
_GUESSED_BY: Final = 20
"""Positions."""
_ON_TICK: Final = 1e-3
"""Part of an inner period by which a reading may lie off a tick and still be taken for it."""


@dataclass(frozen=True, slots=True)
class RecordedWindow:
    """A stretch of a recording, (n,) readings and (m,) commands; instants in ns of run time."""

    at: Instants
    """Of the readings."""
    speed_rad_s: Array
    """NaN where none was told, as in the next two."""
    position_rad: Array
    torque_nm: Array
    held_nm: float
    """Set-point in force before the first command."""
    command_at: Instants
    """The latest instant known at which each command did not act yet."""
    command_nm: Array

    @property
    def begin_s(self) -> float:
        """Where the plant begins, before the first reading, in run time."""
        return float(self.at[0]) / NS_PER_S - WARM_UP_S

    @property
    def first_speed_rad_s(self) -> float:
        """A guess of the speed there, by a parabola through the first positions: the steps of a coarse
        encoder make a speed of zero of one that the friction would hold from then on."""
        known = np.flatnonzero(np.isfinite(self.position_rad))[:_GUESSED_BY]
        if len(known) < _GUESSED_BY:
            return float(self.speed_rad_s[np.isfinite(self.speed_rad_s)][0])
        behind = self.seconds(self.at[known]) - self.begin_s
        return float(np.polyfit(behind, self.position_rad[known], 2)[1])

    def seconds(self, instants: Instants) -> Array:
        """Return instants in seconds of run time."""
        return np.asarray(instants / NS_PER_S, np.float64)

    @property
    def outputs(self) -> Array:
        """(3, n): speed, position and told torque."""
        return np.stack((self.speed_rad_s, self.position_rad, self.torque_nm))


class Rigid(NamedTuple):
    """What is fitted of a drive with a rigid shaft."""

    inertia_kg_m2: float
    viscous_friction_nm_s: float
    coulomb_friction_nm: float
    hanging_nm: float
    """Torque against positive speed at every place: a weight, or an offset of the drive's torque."""
    dead_time_s: float
    """From the arrival of a command to the tick that takes it, as seen in readings taken to be of their SYNC;
    less an inner period, by which a set-point that counts in proportion is late on the mean."""
    speed_filter_s: float
    """Time constant of the filter behind 606Ch."""


class _Reads(NamedTuple):
    """When a window is read."""

    ticks: Instants
    """Rising, behind the begin of the window."""
    low: Instants
    """(n,): place among them of the tick before each reading, or on it."""
    high: Instants
    """(n,): of the tick behind it."""
    share: Array
    """(n,): where between both."""


class TwinPlant:
    """One drive's inner loops with its motor, to be run over any window with any :class:`Rigid`."""

    def __init__(
        self,
        motor: PmsmParameters,
        rate_hz: int,
        current_bandwidth_hz: float | None,
        speed: SpeedSensing,
        path: SetPointPath = STRAIGHT,
        counts: int = FINEST_COUNTS,
    ) -> None:
        """``motor``: what is not fitted is its; ``speed``: how counts are made into 606Ch, ``path``: what
        filters the torque; ``counts`` of the encoder a turn, fewer for a twin that is to be recorded."""
        parameters = FirmwareParameters(
            inner_rate_hz=rate_hz,
            encoder_counts_per_revolution=counts,
            current_bandwidth_hz=current_bandwidth_hz,
            speed=speed,
            brake_torque_nm=0.0,
            path=path,
        )
        self._counts = counts
        self.motor = motor
        self._firmware = Firmware(motor, parameters)
        self._inner = self._firmware.inner
        self._tick_s = 1.0 / rate_hz
        self._rate_hz = rate_hz
        self._firmware.start(Instant(0))
        self._reads_of: dict[int, tuple[RecordedWindow, _Reads]] = {}

    def run(
        self,
        window: RecordedWindow,
        rigid: Rigid,
        speed_rad_s: float,
        *,
        angle_rad: float = 0.0,
        grid_s: float | None = None,
    ) -> Array:
        """Return the outputs, (3, n), of a shaft that begins ``window`` at that speed and angle.

        ``grid_s``: one tick of the drive in run time; a set-point then counts from one tick on, and values
        are those of the tick before each reading. None: nobody knows it, and all counts in proportion.
        """
        self._take(rigid)
        self._begin(window.held_nm, speed_rad_s, angle_rad)
        begin_s = window.begin_s
        if grid_s is None:
            reads = self._known_reads(window)
        else:
            begin_s = grid_s + self._tick_s * math.ceil((begin_s - grid_s) / self._tick_s)
            reads = self._reads(window, begin_s, stepped=True)
        places, kinds, values = self._plan(window, begin_s, rigid.dead_time_s, reads, grid_s is not None)
        inner = self._inner
        advance, demand, first = inner.advance_to, inner.demand_torque, inner.ticks
        at = self._instants(first, places)
        told: list[tuple[float, float, float, float]] = []
        tell = told.append
        for now, kind, value in zip(at, kinds, values, strict=True):
            advance(now)
            if kind:
                demand(value)
            else:
                tell((inner.speed_measured_rad_s, inner.turns, inner.angle_rad, inner.torque_measured_nm))
        return self._outputs(reads, np.array(told).T)

    def _take(self, rigid: Rigid) -> None:
        inner = self._inner
        inner.inertia_kg_m2 = rigid.inertia_kg_m2
        inner.per_inertia = inner.per_inertia_rotor = 1.0 / rigid.inertia_kg_m2
        inner.viscous_friction_nm_s = rigid.viscous_friction_nm_s
        inner.coulomb_friction_nm = rigid.coulomb_friction_nm
        inner.load_nm = rigid.hanging_nm
        inner.speed_filter = self._tick_s / (self._tick_s + rigid.speed_filter_s)

    def _begin(self, torque_nm: float, speed_rad_s: float, angle_rad: float) -> None:
        """A tick without output empties the loops; then the shaft turns, with the currents of its torque."""
        inner = self._inner
        self._firmware.control(InnerControl.OFF)
        inner.advance_to(self._instants(inner.ticks, np.ones(1, np.int64))[0])
        inner.turns = inner.current_d_a = 0.0
        inner.angle_rad, inner.count = angle_rad, math.floor(angle_rad * inner.counts_per_rad)
        inner.speed_rad_s = inner.speed_measured_rad_s = speed_rad_s
        inner.current_q_a = torque_nm * inner.per_torque_constant
        self._firmware.control(InnerControl.TORQUE)
        inner.demand_torque(torque_nm)

    def _instants(self, first: int, places: Instants) -> list[int]:
        """Return the instants of the ticks, ``places`` behind ``first``, rounded up."""
        ticks = first + places
        instants: list[int] = (-((-ticks * NS_PER_S) // self._rate_hz)).tolist()
        return instants

    def _plan(
        self, window: RecordedWindow, begin_s: float, dead_time_s: float, reads: _Reads, stepped: bool
    ) -> tuple[Instants, list[bool], list[float]]:
        """Return what is done behind which tick of the window: a set-point is written, or values are read."""
        come = (window.seconds(window.command_at) - begin_s + dead_time_s) * self._rate_hz
        if stepped:
            come = np.ceil(come)
        follows = np.ceil(come).astype(np.int64)
        before = np.concatenate(([window.held_nm], window.command_nm[:-1]))[: len(come)]
        share = np.ones(len(come)) if stepped else follows - come
        blended = before + share * (window.command_nm - before)
        written = np.maximum(np.stack((follows - 1, follows), axis=1), 0).ravel()
        places = np.concatenate((reads.ticks, written))
        kinds = np.repeat((False, True), (len(reads.ticks), len(written)))
        set_points = np.stack((blended, window.command_nm), axis=1).ravel()
        values = np.concatenate((np.zeros(len(reads.ticks)), set_points))
        order = np.argsort(places, kind="stable")
        return places[order], kinds[order].tolist(), values[order].tolist()

    def _known_reads(self, window: RecordedWindow) -> _Reads:
        """Return the reads of a window that begins where it does: they are the same for every drive."""
        had = self._reads_of.get(id(window))
        if had is None:
            had = self._reads_of[id(window)] = window, self._reads(window, window.begin_s, stepped=False)
        return had[1]

    def _reads(self, window: RecordedWindow, begin_s: float, *, stepped: bool) -> _Reads:
        at = (window.seconds(window.at) - begin_s) * self._rate_hz
        if stepped:
            at = np.floor(at)
        near = np.round(at)
        off = np.abs(at - near) >= _ON_TICK
        low = np.where(off, np.floor(at), near).astype(np.int64)
        ticks = np.unique(np.concatenate((low, low[off] + 1)))
        place = np.searchsorted(ticks, low)
        return _Reads(ticks, place, place + off, np.where(off, at - low, 0.0))

    def _outputs(self, reads: _Reads, told: Array) -> Array:
        """Return the values at the instants of the readings, between the ticks on both sides of each."""
        angle = told[1] * math.tau + told[2]
        if self._counts < FINEST_COUNTS:
            step = math.tau / self._counts
            angle = step * np.floor(angle / step)
        values = np.stack((told[0], angle, told[3]))
        low = values[:, reads.low]
        return np.asarray(low + reads.share * (values[:, reads.high] - low))
