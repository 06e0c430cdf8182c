"""Fit a drive to recordings of it: which keys of a motor file they determine, and how well.

In stages. A part of the windows, by plain least squares, brings the start near; then all of them, with the
noise as it is, give values and covariance. A direction of the parameters that the slopes hardly show (its
singular value) takes its largest key out of the fit: that key keeps the value of the start, and says so.

Torques are in the drive's own unit throughout: inertia, frictions and offset are in proportion to it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from servobench.design.mechanism import Mechanism, Side
from servobench.design.motor import PmsmParameters
from servobench.design.windowed_fit import FitFailed, WindowedFit, WindowedProblem, fit_windows
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.drive_current_loop import current_loop_of
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.recorded.recorded_run import open_run
from servobench.hil.rows.records import Rows
from servobench.hil.twin.bootstrap import bootstrapped
from servobench.hil.twin.plant import FINEST_COUNTS, Array, RecordedWindow, Rigid, TwinPlant
from servobench.hil.twin.windows import WINDOW_S, RecordedWindows, windows_of
from servobench.virtual_bus.drive.encoder import BY_DIFFERENCE
from servobench.virtual_bus.drive.set_point_path import STRAIGHT

COVERAGE_FACTOR: Final = 2.0
COARSE_WINDOWS: Final = 24
"""Of the first stage: five seconds determine a rigid drive, whatever there is more makes it sure."""
SURE: Final = 0.5
"""Of a parameter's scale: a direction that is known no better, at one standard uncertainty, is not known."""
APART: Final = 5.0
"""A window of which so many times more is left than of most is no fit of this drive: a command that was lost
and did not show, a push at the shaft, a start near rest that could not be found."""
_FILTER_MIN_S: Final = 1e-6
"""Time constant of a filter that there is none of: 160 kHz."""

Free = NDArray[np.bool_]
Source = Literal["fitted", "not determined", "fixed"]
"""Where a value is from; of the last two from the start."""


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


@dataclass(frozen=True, slots=True)
class FittedKey:
    """What came of a key."""

    name: str
    unit: str
    value: float
    uncertainty: float | None
    """Expanded, k = 2; None: it is the start's."""
    source: Source
    bias: float | None = None
    """What the bootstrap found the fit off by, on the mean; None: none was asked for."""


@dataclass(frozen=True, slots=True)
class Fit:
    """The result, before it is a motor file."""

    keys: tuple[FittedKey, ...]
    rigid: Rigid
    covariance: Array
    """(f, f) of the keys that were fitted, in their own units."""
    start: MotorFile
    recordings: tuple[FittedRecording, ...]
    held_out: tuple[FittedRecording, ...]
    held_out_ratio: float | None
    """Error on windows that were not fitted, over that on those that were: medians, of the worst output."""
    spread: tuple[float, float, float]
    """What is left of speed, rad/s, position, rad, and torque, N m, rms."""
    converged: bool
    windows: list[RecordedWindow]
    """Those that were fitted."""

    @property
    def left_out(self) -> int:
        """Windows in doubt, with losses or a load, or apart from all others."""
        parts = [each.stretches for each in self.recordings]
        return sum(each.left_out + len(each.windows) for each in parts) - len(self.windows)


def fit_recordings(
    recordings: Sequence[Path | RunLike],
    *,
    start: MotorFile | None = None,
    hold_out: Path | RunLike | None = None,
    fixed: Sequence[str] = (),
    axis: str | None = None,
    bootstrap: int = 0,
    unsealed: bool = False,
) -> Fit:
    """Fit. ``start``: what is not determined stays its; default: the motor of the first recording's bench.

    ``hold_out``: a recording to predict; ``fixed``: keys of :data:`KEYS` that keep the start's value;
    ``bootstrap``: how many times the twin itself is recorded and fitted. Raises BadInput.
    """
    if unknown := [name for name in fixed if name not in KEY_NAMES]:
        raise BadInput("--fix", "", unknown[0], f"one of {', '.join(KEY_NAMES)}")
    fitted = tuple(_opened(each, axis, unsealed) for each in recordings)
    held = () if hold_out is None else (_opened(hold_out, axis, unsealed),)
    first = fitted[0]
    motor = start or first.config.drive[first.axis].motor
    windows = [window for each in fitted for window in each.stretches.windows]
    if len(windows) < 2 * len(KEYS) + 2:
        left_out = sum(each.stretches.left_out for each in fitted)
        told = f"{len(windows)} windows of {WINDOW_S:g} s, {left_out} left out"
        expected = f"{2 * len(KEYS) + 2} windows of torque set-points whose fate is known, without a load"
        raise BadInput(first.name, "", told, expected, "record longer, with ramps both ways")
    drive = _Drive(motor, first)
    free = np.array([key.name not in fixed for key in KEYS])
    try:
        found, free, windows = _fitted(drive, windows, free)
        ratio = _held_out_ratio(drive, held, found)
    except FitFailed as error:
        raise BadInput(first.name, "", str(error), "a recording that a rigid drive explains") from None
    covariance, bias = found.covariance, None
    if bootstrap:
        twin = bootstrapped(drive.problem(windows), windows, drive.recorder(), drive.tick_s, found, bootstrap)
        bias, covariance = twin.bias, _wider(covariance, twin.covariance)
    return _result(drive, found, (covariance, bias), (free, fixed), (fitted, held, ratio), windows)


class _Drive:
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
        filter_hz = self._speed.filter_hz
        return Rigid(
            mechanics.inertia_kg_m2,
            mechanics.viscous_friction_nm_s,
            mechanics.coulomb_friction_nm,
            0.0 if load is None else load.hanging_nm,
            0.0,
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


def _fitted(
    drive: _Drive, windows: list[RecordedWindow], free: Free
) -> tuple[WindowedFit, Free, list[RecordedWindow]]:
    """Return the fit, which keys were free at last, and the windows without those that stand apart."""
    problem, theta = drive.problem(windows), np.array(drive.start)
    chosen = np.unique(np.linspace(0, len(windows) - 1, min(len(windows), COARSE_WINDOWS)).astype(int))
    near, free = _determined(drive, problem.part(chosen.tolist()), theta, free, white=False)
    # once more, from the windows' first guesses: a state that a far start drove to rest does not leave it
    near, free = _determined(drive, problem.part(chosen.tolist()), near.parameters, free, white=False)
    rest = fit_windows(problem, near.parameters, np.zeros(len(KEYS), bool), white=False)
    usual = np.all(rest.spreads <= APART * np.median(rest.spreads, axis=0), axis=1)
    numbers = np.flatnonzero(usual)
    kept = replace(problem.part(numbers.tolist()), initial=rest.initial[numbers])
    found, free = _determined(drive, kept, near.parameters, free, white=True)
    return found, free, [windows[number] for number in numbers.tolist()]


def _determined(
    drive: _Drive, problem: WindowedProblem, theta: Array, free: Free, *, white: bool
) -> tuple[WindowedFit, Free]:
    """Fit, and leave out one key after the other that the windows do not determine."""
    while True:
        found = fit_windows(problem, theta, free, white=white)
        if (sure := _sure(found, free)).all():
            return found, free
        free = free & sure
        theta = np.where(free, theta, np.array(drive.start))


def _sure(found: WindowedFit, free: Free) -> Free:
    """Return which keys may stay free: all, or all but the one that the least direction is made of."""
    keep = np.ones(len(free), bool)
    if not free.any() or found.singular_values[-1] * SURE >= 1.0:
        return keep
    keep[int(np.argmax(np.abs(found.directions[-1])))] = False
    return keep


def _held_out_ratio(drive: _Drive, held: Sequence[FittedRecording], found: WindowedFit) -> float | None:
    windows = [window for each in held for window in each.stretches.windows]
    if not windows:
        return None
    nothing = np.zeros(len(KEYS), bool)
    predicted = fit_windows(drive.problem(windows), found.parameters, nothing, white=False)
    return float(np.max(np.median(predicted.spreads, axis=0) / np.median(found.spreads, axis=0)))


def _wider(sandwich: Array, spread: Array) -> Array:
    """Return the covariance of the sandwich, with the variances of a bootstrap where those are larger."""
    had, has = np.sqrt(np.diag(sandwich)), np.sqrt(np.diag(spread))
    factor = np.where(had > 0.0, np.maximum(has, had) / np.where(had > 0.0, had, 1.0), 1.0)
    return np.asarray(sandwich * np.outer(factor, factor))


def _result(
    drive: _Drive,
    found: WindowedFit,
    uncertain: tuple[Array, Array | None],
    chosen: tuple[Free, Sequence[str]],
    recorded: tuple[tuple[FittedRecording, ...], tuple[FittedRecording, ...], float | None],
    windows: list[RecordedWindow],
) -> Fit:
    (covariance, bias), (free, fixed) = uncertain, chosen
    fitted, held, ratio = recorded
    values = np.where(free, found.parameters, np.array(drive.start))
    slopes = np.array([key.slope(value) for key, value in zip(KEYS, values.tolist(), strict=True)])
    own = covariance * np.outer(slopes, slopes)
    keys = []
    for place, key in enumerate(KEYS):
        source: Source = "fitted" if free[place] else "fixed" if key.name in fixed else "not determined"
        error = COVERAGE_FACTOR * math.sqrt(own[place, place]) if free[place] else None
        off = float(bias[place] * slopes[place]) if bias is not None and free[place] else None
        keys.append(FittedKey(key.name, key.unit, key.told(values[place], drive.tick_s), error, source, off))
    return Fit(
        tuple(keys),
        Rigid(*values.tolist()),
        own[np.ix_(free, free)],
        drive.motor,
        fitted,
        held,
        ratio,
        tuple(found.spread.tolist()),
        found.converged,
        windows,
    )


def _opened(source: Path | RunLike, axis: str | None, unsealed: bool) -> FittedRecording:
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
    mode = config.drive[chosen].mode
    if mode != "cst":
        remedy = 'the twin\'s input is the torque that is commanded; record with mode = "cst"'
        raise BadInput(name, f"drive.{chosen}.mode", mode, "cst", remedy)
    mine = rows[rows["axis"] == config.axes.index(chosen)]
    try:
        stretches = windows_of(mine, config.loop.actuation == "on_sync")
    except ValueError as error:
        raise BadInput(name, chosen, str(error), "a recording with set-points of torque") from None
    return FittedRecording(name, digest, config, chosen, stretches)
