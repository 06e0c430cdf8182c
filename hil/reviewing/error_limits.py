"""Where the limits of an error hold in a run, and the lines that show them.

    speed_error_peak_percent_max  ----|  settling  |------------------------
    after_load_percent_max                               ---------   after a change of load
    drawn: the tighter            ----              -----_________---

No limit holds while a speed settles after a step of its reference.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from servobench.hil.reviewing.envelope import Points
from servobench.hil.reviewing.tracking_error import PositionErrorMeter, SpeedErrorMeter
from servobench.hil.verdict.limits import VerdictLimits

Stretch = tuple[int, int, float]
"""Begin and end, ns, and how large an error may be there."""


def speed_limits(meter: SpeedErrorMeter, limits: VerdictLimits) -> dict[str, float | None]:
    """Return the limits of the speed error, rad/s, by where they hold in words; after a load the largest."""
    peak, after = limits.speed_error_peak_percent_max, limits.after_load_percent_max
    largest = max((size for _, _, size in meter.loaded), default=0.0)
    return {
        "": None if peak is None else peak / 100.0 * meter.reference_peak,
        " after load": None if after is None or not largest else after / 100.0 * largest,
    }


def speed_stretches(meter: SpeedErrorMeter, limits: VerdictLimits, begin: int, end: int) -> list[Stretch]:
    """Return the stretches between ``begin`` and ``end`` in which the speed error is judged; rad/s, the
    tighter of two limits."""
    most, after = speed_limits(meter, limits)[""], limits.after_load_percent_max
    loaded: list[Stretch] = []
    if after is not None:
        loaded = [(a, b, after / 100.0 * size) for a, b, size in meter.loaded if size]
        if most is not None:
            loaded = [each for each in loaded if each[2] < most]
    held = loaded
    if most is not None:
        held = sorted([*loaded, *without([(begin, end, most)], [(a, b) for a, b, _ in loaded])])
    return list(without(held, meter.settling))


def position_stretches(
    meter: PositionErrorMeter, limits: VerdictLimits, begin: int, end: int
) -> list[Stretch]:
    """Return the stretches in which the position error is judged; rad."""
    most = limits.position_error_peak_rad_max
    return [] if most is None else list(without([(begin, end, most)], meter.settling))


def without(stretches: Sequence[Stretch], windows: Sequence[tuple[int, int]]) -> Iterator[Stretch]:
    """Yield what ``windows`` leave of ``stretches``, both in order of time and apart from each other."""
    place = 0
    for begin, end, size in stretches:
        while place < len(windows) and windows[place][1] <= begin:
            place += 1
        at, window = begin, place
        while window < len(windows) and windows[window][0] < end:
            if windows[window][0] > at:
                yield at, windows[window][0], size
            at = windows[window][1]
            window += 1
        if at < end:
            yield at, end, size


def limit_points(stretches: Sequence[Stretch], scale: float = 1.0) -> Points:
    """Return a line over ``stretches``; between two there is no number."""
    times, values = list[int](), list[float]()
    for begin, end, size in stretches:
        if times:
            times.append(min(times[-1] + 1, begin))
            values.append(np.nan)
        times += [begin, end]
        values += [scale * size] * 2
    return np.array(times, np.int64), np.array(values, np.float64)
