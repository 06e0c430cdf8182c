"""The drive behind a recording, as a plant: what may be fitted of it, from where, and to what."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from servobench.design.mechanism import Mechanism, Side
from servobench.design.motor import PmsmParameters
from servobench.design.windowed_fit import WindowedProblem
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.drive_current_loop import current_loop_of
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.recorded.recorded_run import open_run
from servobench.hil.rows.records import Rows
from servobench.hil.twin.plant import FINEST_COUNTS, Array, RecordedWindow, Rigid, TwinPlant
from servobench.hil.twin.windows import RecordedWindows, windows_of
from servobench.virtual_bus.drive.encoder import BY_DIFFERENCE
from servobench.virtual_bus.drive.set_point_path import STRAIGHT

_FILTER_MIN_S: Final = 1e-6
"""Time constant of a filter that there is none of: 160 kHz."""


class RunLike(Protocol):
    """What of a run is read: a :class:`servobench.Run` has it."""

    @property
    def config(self) -> BenchConfig: ...

    @property
    def rows(self) -> Rows: ...

    @property
    def digest(self) -> str: ...


@dataclass(frozen=True, slots=True)
class FittedRecording:
    """One recording of the axis."""

    name: str
    digest: str
    config: BenchConfig
    axis: str
    stretches: RecordedWindows


@dataclass(frozen=True, slots=True)
class Key:
    """A key of the motor file, and the field of :class:`Rigid` behind it."""

    name: str
    unit: str
    told: Callable[[float, float], float] = lambda value, _tick_s: value
    """From the field, and the inner period, to the key's own unit."""
    slope: Callable[[float], float] = lambda _value: 1.0
    """Of that, over the field."""


KEYS: Final = (
    Key("mechanics.inertia_kg_m2", "kg m^2"),
    Key("mechanics.viscous_friction_nm_s", "N m s"),
    Key("mechanics.coulomb_friction_nm", "N m"),
    Key("load.hanging_nm", "N m"),
    Key("twin.dead_time_us", "us", lambda value, tick_s: 1e6 * (value + tick_s), lambda _value: 1e6),
    Key(
        "twin.speed_filter_hz",
        "Hz",
        lambda value, _tick_s: 1.0 / (math.tau * value),
        lambda value: -1.0 / (math.tau * value**2),
    ),
)
"""In the order of the fields."""
KEY_NAMES: Final = tuple(key.name for key in KEYS)


class TwinDrive:
    """The plant of an axis, and what is known before the fit."""

    def __init__(self, motor: MotorFile, recording: FittedRecording) -> None:
        """``motor``: the start."""
        config, axis = recording.config, recording.axis
        self.motor = motor
        self._simulation = config.drive[axis].simulation
        self._unit_nm = recording.stretches.torque_unit_nm
        self._position_rad = recording.stretches.position_unit_rad
        like = {} if self._simulation.like is None else self._simulation.like.parameters
        self._speed, self._path = like.get("speed", BY_DIFFERENCE), like.get("path", STRAIGHT)
        loop = current_loop_of(config, axis)
        self._current_hz = (
            None if loop is None else min(loop.bandwidth_hz, self._simulation.inner_rate_hz / 8)
        )
        self.tick_s = 1.0 / self._simulation.inner_rate_hz
        self._plant = self._twin(FINEST_COUNTS)

    def _twin(self, counts: int) -> TwinPlant:
        rate_hz = self._simulation.inner_rate_hz
        return TwinPlant(self._rigid_motor(), rate_hz, self._current_hz, self._speed, self._path, counts)

    def _rigid_motor(self) -> PmsmParameters:
        """The start without what a rigid structure has not: of its mechanism its friction alone."""
        parameters = self.motor.parameters
        friction = None if parameters.mechanism is None else parameters.mechanism.friction
        rigid = None if friction is None else Mechanism(friction=replace(friction, side=Side.MOTOR))
        return replace(parameters, mechanism=rigid, iron=None, heat=None)

    @property
    def start(self) -> Rigid:
        mechanics, load = self.motor.mechanics, self.motor.load
        filter_hz, dead_time_s = self._speed.filter_hz, 0.0
        if self.motor.twin is not None:
            filter_hz = self.motor.twin.speed_filter_hz
            dead_time_s = 1e-6 * self.motor.twin.dead_time_us - self.tick_s
        return Rigid(
            mechanics.inertia_kg_m2,
            mechanics.viscous_friction_nm_s,
            mechanics.coulomb_friction_nm,
            0.0 if load is None else load.hanging_nm,
            dead_time_s,
            _FILTER_MIN_S if filter_hz is None else 1.0 / (math.tau * filter_hz),
        )

    @property
    def scale(self) -> Rigid:
        """What is a large change: all of an inertia, a hundredth of the rated torque, and times that no
        controller of a bench notices."""
        rating = self.motor.parameters
        torque_nm = 0.01 * rating.rated_torque_nm
        viscous = torque_nm / rating.rated_speed_rad_s
        return Rigid(self.motor.mechanics.inertia_kg_m2, viscous, torque_nm, torque_nm, 50e-6, 100e-6)

    def recorder(self) -> TwinPlant:
        """The twin with the encoder of the recording, for a bootstrap."""
        counts = max(16, round(math.tau / self._position_rad)) if self._position_rad > 0.0 else FINEST_COUNTS
        return self._twin(min(counts, FINEST_COUNTS))

    def problem(self, windows: Sequence[RecordedWindow], initial: Array | None = None) -> WindowedProblem:
        plant, inertia = self._plant, self.motor.mechanics.inertia_kg_m2
        per_root = 1.0 / math.sqrt(12.0)
        first = [window.first_speed_rad_s for window in windows]
        return WindowedProblem(
            measured=tuple(window.outputs for window in windows),
            initial=np.array(first) if initial is None else initial,
            initial_scale=0.01 * self.motor.parameters.rated_speed_rad_s,
            model=lambda number, theta, state: plant.run(windows[number], Rigid(*theta.tolist()), state),
            floors=per_root * np.array([1e-6, max(self._position_rad, 1e-9), abs(self._unit_nm)]),
            offset=(False, True, False),
            scale=np.array(self.scale),
            lowest=np.array([1e-3 * inertia, 0.0, 0.0, -math.inf, -math.inf, _FILTER_MIN_S]),
        )


def opened_recording(source: Path | RunLike, axis: str | None, unsealed: bool) -> FittedRecording:
    """Read the windows of a recording. Raises BadInput."""
    if isinstance(source, Path):
        run = open_run(source, unsealed=unsealed, whole=True)
        name, digest, config = str(source), run.summary.digest, run.config
        batches = list(run.rows())
        rows = np.concatenate(batches)
    else:
        name, digest, config, rows = source.config.bench.name, source.digest, source.config, source.rows
    if axis is None and len(config.axes) > 1:
        raise BadInput(name, "axis", "several", f"--axis with one of {', '.join(config.axes)}")
    chosen = axis or config.axes[0]
    if chosen not in config.axes:
        raise BadInput("--axis", "", chosen, f"one of {', '.join(config.axes)}")
    check_mode(name, chosen, config.drive[chosen].mode)
    mine = rows[rows["axis"] == config.axes.index(chosen)]
    try:
        stretches = windows_of(mine, config.loop.actuation == "on_sync")
    except ValueError as error:
        raise BadInput(name, chosen, str(error), "a recording with set-points of torque") from None
    return FittedRecording(name, digest, config, chosen, stretches)


def check_mode(source: str, axis: str, mode: str) -> None:
    """Raise BadInput for an axis whose set-points are not of torque."""
    if mode != "cst":
        remedy = 'the twin\'s input is the torque that is commanded; record with mode = "cst"'
        raise BadInput(source, f"drive.{axis}.mode", mode, "cst", remedy)
