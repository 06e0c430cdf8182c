"""Fit a drive to recordings of it: which keys of a motor file they determine, and how well.

In stages. A part of the windows, by plain least squares, brings the start near; then all of them, with the
noise as it is, give values and covariance. A direction of the parameters that the slopes hardly show (its
singular value) takes its largest key out of the fit: that key keeps the value of the start, and says so.

Torques are in the drive's own unit throughout: inertia, frictions and offset are in proportion to it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from servobench.design.windowed_fit import FitFailed, WindowedFit, WindowedProblem, fit_windows
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.twin.bootstrap import bootstrapped
from servobench.hil.twin.plant import Array, RecordedWindow, Rigid
from servobench.hil.twin.twin_drive import (
    KEY_NAMES,
    KEYS,
    FittedRecording,
    RunLike,
    TwinDrive,
    opened_recording,
)
from servobench.hil.twin.windows import WINDOW_S

COVERAGE_FACTOR: Final = 2.0
COARSE_WINDOWS: Final = 24
"""Of the first stage: five seconds determine a rigid drive, whatever there is more makes it sure."""
SURE: Final = 0.5
"""Of a parameter's scale: a direction that is known no better, at one standard uncertainty, is not known."""
APART: Final = 5.0
"""A window of which so many times more is left than of most is no fit of this drive: a command that was lost
and did not show, a push at the shaft, a start near rest that could not be found."""
Free = NDArray[np.bool_]
Source = Literal["fitted", "not determined", "fixed"]
"""Where a value is from; of the last two from the start."""


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
    spreads: Array
    """(w, 3): the same of each window, and no less than the quantum of a reading makes."""
    speed_left: list[Array]
    """(n,) of each window."""
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
    fitted = tuple(opened_recording(each, axis, unsealed) for each in recordings)
    held = () if hold_out is None else (opened_recording(hold_out, axis, unsealed),)
    first = fitted[0]
    motor = start or first.config.drive[first.axis].motor
    windows = [window for each in fitted for window in each.stretches.windows]
    if len(windows) < 2 * len(KEYS) + 2:
        left_out = sum(each.stretches.left_out for each in fitted)
        told = f"{len(windows)} windows of {WINDOW_S:g} s, {left_out} left out"
        expected = f"{2 * len(KEYS) + 2} windows of torque set-points whose fate is known, without a load"
        raise BadInput(first.name, "", told, expected, "record longer, with ramps both ways")
    drive = TwinDrive(motor, first)
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


def _fitted(
    drive: TwinDrive, windows: list[RecordedWindow], free: Free
) -> tuple[WindowedFit, Free, list[RecordedWindow]]:
    """Return the fit, which keys were free at last, and the windows without those that stand apart."""
    problem, theta = drive.problem(windows), np.array(drive.start)
    chosen = np.unique(np.linspace(0, len(windows) - 1, min(len(windows), COARSE_WINDOWS)).astype(int))
    near, free = _determined(drive, problem.part(chosen.tolist()), theta, free, white=False)
    # once more, from the windows' first guesses: a state that a far start drove to rest does not leave it
    near, free = _determined(drive, problem.part(chosen.tolist()), near.parameters, free, white=False)
    rest = fit_windows(problem, near.parameters, np.zeros(len(KEYS), bool), white=False)
    most = APART * np.maximum(np.median(rest.spreads, axis=0), problem.floors)
    usual = np.all(rest.spreads <= most, axis=1)
    numbers = np.flatnonzero(usual)
    kept = replace(problem.part(numbers.tolist()), initial=rest.initial[numbers])
    found, free = _determined(drive, kept, near.parameters, free, white=True)
    return found, free, [windows[number] for number in numbers.tolist()]


def _determined(
    drive: TwinDrive, problem: WindowedProblem, theta: Array, free: Free, *, white: bool
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


def _held_out_ratio(drive: TwinDrive, held: Sequence[FittedRecording], found: WindowedFit) -> float | None:
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
    drive: TwinDrive,
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
        np.maximum(found.spreads, drive.problem(windows).floors),
        [each[0] for each in found.left],
        found.converged,
        windows,
    )
