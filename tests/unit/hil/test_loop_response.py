"""The lag inside a drive's speed loop, found from responses that were integrated apart, step by step, for
drives as the simulated one is none: without feed-forward, with a set-point that stays until the next one.
"""

import math
from typing import Final

import numpy as np
import pytest

from servobench.hil.commissioning.excitation import FrequencyResponse, lines_hz, multisine
from servobench.hil.commissioning.identify import Array
from servobench.hil.commissioning.loop_response import Excited, Gains, NotFound, loop_plant

INERTIA, VISCOUS, PERIOD_S, BLOCK_S = 0.002, 0.001, 1e-3, 0.5
STEPS: Final = 50
"""Of the integration in a period."""
LINES: Final = lines_hz(4.0, 250.0, 28, BLOCK_S)


def responded(
    gains: Gains, delay_s: float, filter_s: float, feed: float, acts: float = 1.0, smooth_s: float = 0.0
) -> Excited:
    """Integrate a loop by Euler's rule over two blocks; the first one settles.

    ``smooth_s``: of a filter of the set-point.
    """
    step_s = PERIOD_S / STEPS
    added = multisine(LINES, 1.0, 3, np.minimum(1.0, 20.0 / LINES))
    count = round(2 * BLOCK_S / PERIOD_S)
    given = np.array([added(k * PERIOD_S) for k in range(count)])
    late = round(delay_s / step_s)
    torques = [0.0] * late
    speed = told = integral = angle = wanted = 0.0
    seen, turned = np.empty(count), np.empty(count)
    for k in range(count):
        seen[k], turned[k] = told, angle
        fed_nm = feed * INERTIA * (given[k] - given[k - 1]) / PERIOD_S if k else 0.0
        for _ in range(STEPS):
            wanted += (given[k] - wanted) * (step_s / smooth_s if smooth_s else 1.0)
            error = wanted - told
            integral += acts * gains.integral * error * step_s
            torques.append(acts * gains.proportional * error + integral + fed_nm)
            angle += speed * step_s
            speed += (torques.pop(0) - VISCOUS * speed) / INERTIA * step_s
            told += (speed - told) * step_s / filter_s
    half = slice(count // 2, count)
    made = np.diff(turned, prepend=turned[0])[half] / PERIOD_S
    s = 2j * math.pi * LINES
    differenced = (1.0 - np.exp(-s * PERIOD_S)) / (s * PERIOD_S)
    return Excited(_over(seen[half], given[half]), _over(made, given[half], differenced), gains)


def _over(output: Array, given: Array, by: Array | float = 1.0) -> FrequencyResponse:
    bins = np.round(LINES * BLOCK_S).astype(int)
    response = np.fft.rfft(output)[bins] / np.fft.rfft(given)[bins] / by
    return FrequencyResponse(LINES, np.asarray(response, dtype=complex), np.full(len(LINES), 0.9999))


def loop_of(hz: float) -> Gains:
    return Gains(math.tau * hz * INERTIA, 0.2 * INERTIA * (math.tau * hz) ** 2)


@pytest.mark.parametrize(
    ("hz", "delay_us", "filter_us"), [(10.0, 200, 300), (40.0, 1000, 300), (40.0, 300, 2000)]
)
def test_the_lag_of_a_loop_that_feeds_nothing_forward(hz: float, delay_us: int, filter_us: int) -> None:
    found = loop_plant(
        [responded(loop_of(hz), 1e-6 * delay_us, 1e-6 * filter_us, 0.0)], INERTIA, VISCOUS, PERIOD_S
    )
    assert found.lag_in_all_s == pytest.approx(1e-6 * (delay_us + filter_us), abs=6e-5)
    assert found.feed_share == pytest.approx(0.0, abs=0.05)
    assert found.misfit < 0.002, "0.004 without the images of the set-point's corners"


def test_a_filter_of_the_set_point_is_no_lag_of_the_loop() -> None:
    smoothed = responded(loop_of(40.0), 5e-4, 3e-4, 0.0, smooth_s=3e-3)
    found = loop_plant([smoothed], INERTIA, VISCOUS, PERIOD_S)
    assert found.lag_in_all_s == pytest.approx(8e-4, abs=1e-4)
    assert found.misfit < 0.02


def test_gains_that_act_as_others_are_seen_beside_those_before() -> None:
    slow = responded(loop_of(15.0), 5e-4, 3e-4, 0.0)
    fast = responded(loop_of(40.0), 5e-4, 3e-4, 0.0, acts=1.4)
    found = loop_plant([slow, fast], INERTIA, VISCOUS, PERIOD_S)
    assert found.share == pytest.approx(1.4, rel=0.03)


def test_lines_that_are_noise_show_nothing() -> None:
    quiet = responded(loop_of(15.0), 5e-4, 3e-4, 0.0)
    noise = np.full(len(LINES), 0.2)
    lost = Excited(
        FrequencyResponse(LINES, quiet.told.response, noise),
        FrequencyResponse(LINES, quiet.made.response, noise),
        quiet.gains,
    )
    with pytest.raises(NotFound, match="fewer than 8 lines are coherent"):
        loop_plant([lost], INERTIA, VISCOUS, PERIOD_S)
