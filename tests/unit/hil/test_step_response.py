"""Step responses against closed forms."""

import math

import numpy as np
import pytest

from servobench.hil.reviewing.review import StepMeter, worst_steps
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import StepResponse
from servobench.hil.verdict.metrics import VerdictLimits
from tests.unit.hil.row_tools import plain_rows

AXIS = AxisPlan("axis1", 6_250.0)
CYCLES, STEP, LOAD = 1_000, 100, 600
TAU_S = 0.03


def first_order(target: float = 50.0) -> Rows:
    """A step at 100 ms with a lag of 30 ms; at 600 ms a load that takes a tenth away, which decays so too."""
    at_s = np.arange(CYCLES) * 1e-3
    reference = np.where(at_s >= STEP * 1e-3, target, 0.0)
    speed = np.where(at_s >= STEP * 1e-3, target * (1.0 - np.exp(-(at_s - STEP * 1e-3) / TAU_S)), 0.0)
    sag = np.where(at_s >= LOAD * 1e-3, 0.1 * target * np.exp(-(at_s - LOAD * 1e-3) / TAU_S), 0.0)
    load = np.where(at_s >= LOAD * 1e-3, 0.6, 0.0)
    return plain_rows(CYCLES, reference=reference, velocity=speed - sag, load=load)


def figures(rows: Rows, chunk: int = CYCLES) -> StepResponse:
    meter = StepMeter(AXIS, 2.0)
    for start in range(0, rows.size, chunk):
        meter.add(rows[start : start + chunk])
    return meter.figures()


@pytest.mark.parametrize("chunk", [1, 7, 100, CYCLES])
@pytest.mark.parametrize("target", [50.0, -50.0])
def test_a_lag_of_the_first_order_settles_as_its_closed_form(chunk: int, target: float) -> None:
    found = figures(first_order(target), chunk)
    assert found.settling_time_ms == math.floor(1e3 * TAU_S * math.log(1 / 0.02))
    assert found.recovery_time_ms == math.floor(1e3 * TAU_S * math.log(0.1 / 0.02))
    assert found.overshoot_percent == 0.0


def test_the_overshoot_of_a_second_order_is_its_closed_form() -> None:
    damping, natural = 0.4, 60.0
    at_s = np.arange(900) * 1e-3
    damped = natural * math.sqrt(1 - damping**2)
    swing = np.cos(damped * at_s) + damping / math.sqrt(1 - damping**2) * np.sin(damped * at_s)
    speed = 80.0 * (1.0 - np.exp(-damping * natural * at_s) * swing)
    found = figures(plain_rows(900, reference=80.0, velocity=speed))
    expected = 100.0 * math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
    assert found.overshoot_percent == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("chunk", [1, 7, CYCLES])
@pytest.mark.parametrize("most_ms", [20.0, 20.5, 1_000.0])
def test_a_limit_that_comes_before_the_speed_is_broken_until_it_comes(chunk: int, most_ms: float) -> None:
    """Settled after 117 ms, recovered after 48."""
    limits = VerdictLimits(settling_time_ms_max=most_ms, recovery_time_ms_max=most_ms)
    meter = StepMeter(AXIS, 2.0, limits)
    rows = first_order()
    for start in range(0, rows.size, chunk):
        meter.add(rows[start : start + chunk])
    came = 1e3 * TAU_S * math.log(1 / 0.02), 1e3 * TAU_S * math.log(0.1 / 0.02)
    at_ms = [
        (STEP + most_ms, STEP + math.floor(came[0]) + 1),
        (LOAD + most_ms, LOAD + math.floor(came[1]) + 1),
    ]
    zero = int(rows["due_at"][0])
    assert [((a - zero) / 1e6, (b - zero) / 1e6) for a, b in meter.late] == (at_ms if most_ms < 48 else [])
    assert meter.overshot == []


@pytest.mark.parametrize("chunk", [1, 7, 900])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_overshoot_breaks_its_limit_where_it_is_beyond_it(chunk: int, sign: float) -> None:
    at = np.arange(900)
    speed = sign * np.where((at >= 100) & (at < 130), 88.1, np.where(at < 50, 0.0, 88.0))
    rows = plain_rows(900, reference=sign * 80.0, velocity=speed)
    meter = StepMeter(AXIS, 20.0, VerdictLimits(overshoot_percent_max=10.0))
    for start in range(0, rows.size, chunk):
        meter.add(rows[start : start + chunk])
    zero = int(rows["due_at"][0])
    assert [((a - zero) // 1_000_000, (b - zero) // 1_000_000) for a, b in meter.overshot] == [(100, 130)]
    assert meter.late == []


def test_a_step_that_does_not_settle_has_no_time() -> None:
    rows = first_order()[: STEP + 50]
    assert figures(rows).settling_time_ms is None
    settled, other = StepMeter(AXIS, 2.0), StepMeter(AXIS, 2.0)
    settled.add(first_order()[:LOAD])
    other.add(rows)
    assert settled.figures().settling_time_ms is not None
    assert worst_steps([settled, other]).settling_time_ms is None, "nor has the worst of both"


def test_a_ramp_is_no_step() -> None:
    ramp = np.linspace(0.0, 50.0, CYCLES)
    assert figures(plain_rows(CYCLES, reference=ramp, velocity=0.9 * ramp)) == StepResponse()


@pytest.mark.parametrize("chunk", [1, 7, CYCLES])
def test_a_load_that_changes_from_cycle_to_cycle_makes_no_steps_but_at_its_end(chunk: int) -> None:
    """A load as of a file rises within 200 ms, and takes the speed out of its band until 30 ms later."""
    cycle = np.arange(CYCLES)
    load = np.interp(cycle, [300, 500], [0.0, 0.6])
    speed = np.where((cycle >= 350) & (cycle < 530), 45.0, 50.0)
    found = figures(plain_rows(CYCLES, reference=50.0, velocity=speed, load=load), chunk)
    assert found.recovery_time_ms == 29.0
