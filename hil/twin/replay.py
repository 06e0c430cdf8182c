"""A recording replayed on a twin: where drive and twin part by more than the twin's uncertainty allows.

The twin gets the commands of the recording at the instants at which they acted. Each window begins with a
speed and an angle of its own, which are fitted; nothing else is. With C the covariance of the twin's keys, A
the slopes of a window's outputs over them, without what the window's beginning explains, and l the most that
was left of a window when the twin was fitted, the difference may be

    sqrt((1.2 l)^2 + (2 u)^2) rms,   u^2 = mean of diag(A C A')

Over the frequency the same holds of the octaves of the speed's difference, and the scatter of few lines.
Over the angle its means are held against their own scatter from window to window: what a shaft shows at one
angle again and again is no noise.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from servobench.design.windowed_fit import FitFailed, WindowedFit, WindowedProblem, fit_windows
from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.configuration.twin_table import TwinTable
from servobench.hil.twin.plant import Array, RecordedWindow
from servobench.hil.twin.twin_drive import KEY_NAMES, KEYS, RunLike, TwinDrive, opened_recording
from servobench.hil.twin.windows import octaves_of

PREDICTED_MAX: Final = 1.2
"""Error of what was not fitted over that of what was, above which the drive has what the twin lacks."""
OUTSIDE_SHARE_MAX: Final = 0.05
"""Of the windows within the range of validity."""
_PLACES: Final = 72
"""Of the angle: cogging of up to 36 periods a turn shows."""
_SEEN_MIN: Final = 4
"""Windows, for their scatter."""
_SURE: Final = 4.0
"""Standard errors: of 72 places one in 200 comparisons lies farther off by chance."""
_MARGIN: Final = 0.01
"""Of a range: noise reaches past it."""
_STATE_STEP: Final = 1e-3
OUTPUTS: Final = (("speed", "rad/s"), ("position", "rad"), ("torque", "N m"))

Judgement = Literal["within", "outside", "out of range"]


@dataclass(frozen=True, slots=True)
class HeldDifference:
    """A difference between drive and twin, and what is allowed of it."""

    difference: float
    allowed: float
    judgement: Judgement


@dataclass(frozen=True, slots=True)
class ReplayedWindow:
    """A stretch of time; rms of speed, rad/s, position, rad, and torque, N m."""

    begin_ns: int
    """Run time."""
    end_ns: int
    speed: HeldDifference
    position: HeldDifference
    torque: HeldDifference

    @property
    def judgement(self) -> Judgement:
        """Return the worst of the three."""
        each = {self.speed.judgement, self.position.judgement, self.torque.judgement}
        return "outside" if "outside" in each else self.speed.judgement


@dataclass(frozen=True, slots=True)
class Replay:
    """The result."""

    recording: str
    axis: str
    windows: tuple[ReplayedWindow, ...]
    left_out: int
    """Windows in doubt, with losses or a load."""
    places: dict[int, HeldDifference]
    """By angle of the shaft, degrees where each place begins: mean of the speed's difference, rad/s."""
    octaves: dict[float, HeldDifference]
    """By frequency, Hz where each octave begins: rms of the speed's difference, rad/s."""

    def windows_of(self, judgement: Judgement) -> list[ReplayedWindow]:
        """Return those judged so."""
        return [window for window in self.windows if window.judgement == judgement]

    @property
    def judgement(self) -> Judgement:
        """Return that of the whole: "out of range" if fewer than two windows are within the range."""
        valid = len(self.windows) - len(self.windows_of("out of range"))
        if valid < 2:
            return "out of range"
        apart = len(self.windows_of("outside")) > max(1.0, OUTSIDE_SHARE_MAX * valid)
        others = [*self.places.values(), *self.octaves.values()]
        return "outside" if apart or any(each.judgement == "outside" for each in others) else "within"


def replay(
    recording: Path | RunLike, motor: MotorFile, *, axis: str | None = None, unsealed: bool = False
) -> Replay:
    """Replay a recording on a twin, ``motor`` with its table [twin]. Raises BadInput."""
    if motor.twin is None:
        raise BadInput("--twin", "twin", "no such table", "a motor file by hil fit")
    read = opened_recording(recording, axis, unsealed)
    windows = read.stretches.windows
    drive = TwinDrive(motor, read)
    problem = drive.problem(windows)
    try:
        nothing = np.zeros(len(KEYS), bool)
        found = fit_windows(problem, np.array(drive.start), nothing, white=False)
    except FitFailed as error:
        raise BadInput(read.name, "", str(error), "a recording of two windows or more") from None
    factor = _factor(motor.twin, drive)
    allowed = [_uncertain(problem, number, found, factor) for number in range(len(windows))]
    in_range = [_in_range(motor.twin, window) for window in windows]
    return Replay(
        read.name,
        read.axis,
        tuple(
            _window(motor.twin, window, found.spreads[number], allowed[number], in_range[number])
            for number, window in enumerate(windows)
        ),
        read.stretches.left_out,
        _over_angle(windows, found, allowed, in_range),
        _over_frequency(motor.twin, found, allowed, in_range),
    )


def _factor(twin: TwinTable, drive: TwinDrive) -> Array:
    """Return F, (p, r), in the units of the plant: F F' is the covariance of all keys."""
    fitted = [KEY_NAMES.index(key.name) for key in twin.key if key.source == "fitted"]
    start = drive.start
    slopes = np.array([KEYS[place].slope(start[place]) for place in fitted])
    values, vectors = np.linalg.eigh(np.array(twin.covariance) / np.outer(slopes, slopes))
    factor = np.zeros((len(KEYS), len(fitted)))
    factor[fitted] = vectors * np.sqrt(np.maximum(values, 0.0))
    return factor


def _uncertain(problem: WindowedProblem, number: int, found: WindowedFit, factor: Array) -> Array:
    """Return what one standard deviation of each direction makes of a window's outputs, (r, o, n), without
    what its beginning explains; NaN where nothing was measured."""
    theta, state = found.parameters, float(found.initial[number])
    at, measured = problem.model(number, theta, state), problem.measured[number]
    there, sigma = np.isfinite(measured), found.noise.sigma[:, None]
    step = _STATE_STEP * problem.initial_scale
    own = [(problem.model(number, theta, state + step) - at) / step]
    for output, free in enumerate(problem.offset):
        if free and there[output].any():
            own.append(np.zeros(measured.shape))
            own[-1][output] = 1.0
    basis, weights, _ = np.linalg.svd(
        np.stack([(each / sigma)[there] for each in own], axis=1), full_matrices=False
    )
    basis = basis[:, weights > 1e-9 * weights[0]]
    parts = np.full((factor.shape[1], *measured.shape), np.nan)
    for direction, column in enumerate(factor.T):
        moved = ((problem.model(number, theta + column, state) - at) / sigma)[there]
        parts[direction][there] = moved - basis @ (basis.T @ moved)
    return np.asarray(parts * sigma)


def _in_range(twin: TwinTable, window: RecordedWindow) -> bool:
    ranges = ((twin.speed_rpm, RPM_PER_RAD_S * window.speed_rad_s), (twin.torque_nm, window.command_nm))
    for (low, high), values in ranges:
        margin = _MARGIN * (high - low)
        if np.nanmin(values, initial=low) < low - margin or np.nanmax(values, initial=high) > high + margin:
            return False
    return True


def _beside(
    difference: float, left: float, uncertain: float, valid: bool = True, most: float = PREDICTED_MAX
) -> HeldDifference:
    allowed = math.hypot(most * left, 2.0 * uncertain)
    return HeldDifference(
        difference,
        allowed,
        "out of range" if not valid else "within" if abs(difference) <= allowed else "outside",
    )


def _window(
    twin: TwinTable, window: RecordedWindow, spread: Array, parts: Array, valid: bool
) -> ReplayedWindow:
    beside = []
    for output, left in enumerate(twin.left):
        known = parts[:, output][:, np.isfinite(parts[0, output])] if len(parts) else np.empty((0, 0))
        uncertain = math.sqrt(float(np.sum(known**2)) / known.shape[1]) if known.size else 0.0
        beside.append(_beside(float(spread[output]), left, uncertain, valid))
    return ReplayedWindow(int(window.at[0]), int(window.at[-1]), *beside)


def _over_angle(
    windows: Sequence[RecordedWindow], found: WindowedFit, allowed: Sequence[Array], in_range: Sequence[bool]
) -> dict[int, HeldDifference]:
    """Return the means by place; those that fewer windows saw than tell a scatter are left out."""
    seen: dict[int, list[float]] = {}
    uncertain: dict[int, list[Array]] = {}
    for number, window in enumerate(windows):
        if not in_range[number]:
            continue
        left = found.left[number][0]
        known = np.isfinite(left) & np.isfinite(window.position_rad)
        turn = np.mod(window.position_rad[known], math.tau) / math.tau
        places = np.minimum((turn * _PLACES).astype(int), _PLACES - 1)
        for place in np.unique(places).tolist():
            here = np.flatnonzero(known)[places == place]
            seen.setdefault(place, []).append(float(left[here].mean()))
            uncertain.setdefault(place, []).append(allowed[number][:, 0, here].mean(axis=1))
    result = {}
    for place, means in sorted(seen.items()):
        if len(means) >= _SEEN_MIN:
            error = float(np.std(means, ddof=1)) / math.sqrt(len(means))
            off = float(np.linalg.norm(np.mean(uncertain[place], axis=0)))
            degrees = round(360 * place / _PLACES)
            result[degrees] = _beside(float(np.mean(means)), error, off, most=_SURE)
    return result


def _over_frequency(
    twin: TwinTable, found: WindowedFit, allowed: Sequence[Array], in_range: Sequence[bool]
) -> dict[float, HeldDifference]:
    valid = [number for number, within in enumerate(in_range) if within]
    if not valid:
        return {}
    rms = octaves_of([found.left[number][0] for number in valid])
    uncertain = np.zeros(len(rms))
    for direction in range(allowed[0].shape[0]):
        uncertain += octaves_of([allowed[number][direction, 0] for number in valid]) ** 2
    fitted = sum(each.windows for each in twin.recording if not each.held_out)
    result = {}
    for octave, left in enumerate(twin.left_bands[: len(rms)]):
        begin_hz, lines = 2.0**octave / twin.window_s, 2.0**octave
        by_chance = _SURE * math.sqrt((1.0 / len(valid) + 1.0 / fitted) / lines) / 2.0
        off, of_band = math.sqrt(float(uncertain[octave])), begin_hz <= twin.band_hz[1]
        result[begin_hz] = _beside(float(rms[octave]), left, off, of_band, PREDICTED_MAX + by_chance)
    return result


def replay_json(found: Replay) -> dict[str, Any]:
    """Return what ``hil compare --twin --json`` prints."""
    return {
        "run": found.recording,
        "axis": found.axis,
        "judgement": found.judgement,
        "windows": [{**asdict(window), "judgement": window.judgement} for window in found.windows],
        "left_out": found.left_out,
        "angle_deg": {str(place): asdict(each) for place, each in found.places.items()},
        "frequency_hz": {f"{place:g}": asdict(each) for place, each in found.octaves.items()},
    }


def replay_lines(found: Replay) -> list[str]:
    """Return the text of it."""
    windows = found.windows
    counts = {name: len(found.windows_of(name)) for name in ("within", "outside", "out of range")}
    told = ", ".join(f"{count} {name}" for name, count in counts.items())
    lines = [f"{found.recording} on its twin, {found.axis}: {found.judgement}", f"windows: {told}"]
    lines[-1] += f", {found.left_out} left out"
    for place, (name, unit) in enumerate(OUTPUTS):
        each = [(window.speed, window.position, window.torque)[place] for window in windows]
        worst = max(range(len(each)), key=lambda number: each[number].difference / each[number].allowed)
        at_s = windows[worst].begin_ns / NS_PER_S
        sizes = f"{each[worst].difference:10.3g} {unit:5s} allowed {each[worst].allowed:10.3g}"
        lines.append(f"{name:10s}{sizes}  {each[worst].judgement}, at worst, at {at_s:.1f} s")
    lines += _worst("angle", "deg", found.places)
    for begin_hz, one in found.octaves.items():
        sizes = f"{one.difference:10.3g} rad/s allowed {one.allowed:10.3g}"
        lines.append(f"{f'{begin_hz:g} Hz':10s}{sizes}  {one.judgement}")
    return lines


def _worst(name: str, unit: str, places: dict[int, HeldDifference]) -> list[str]:
    if not places:
        return [f"{name:10s}not seen often enough"]
    place, one = max(places.items(), key=lambda each: abs(each[1].difference) / max(each[1].allowed, 1e-300))
    outside = sum(each.judgement == "outside" for each in places.values())
    told = f"{outside} of {len(places)} places outside; at worst, at {place} {unit}"
    return [f"{name:10s}{abs(one.difference):10.3g} rad/s allowed {one.allowed:10.3g}  {told}"]
