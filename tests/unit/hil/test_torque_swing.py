"""A limit cycle is seen, and noise is not taken for one."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.reviewing.review import Review
from servobench.hil.reviewing.torque_swing import BLOCK, TorqueSwingMeter
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import Rows
from tests.unit.hil.row_tools import plain_rows

RATED_NM = 2.0
AXIS = AxisPlan("axis1", 6_250.0, RATED_NM)
SETTLING = 250 * NS_PER_MS
COUNT = 1_000
Array = NDArray[np.float64]


def rows_with(torque: Array, **columns: float | list[float]) -> Rows:
    rows = plain_rows(torque.size, **columns)  # type: ignore[arg-type]
    rows["command_torque_nm"] = torque
    return rows


def meter_of(*chunks: Rows) -> TorqueSwingMeter:
    meter = TorqueSwingMeter(AXIS, SETTLING)
    for chunk in chunks:
        meter.add(chunk)
    return meter


def alternating(count: int) -> Array:
    """As the design for R/L commanded on a drive of 800 Hz."""
    return np.where(np.arange(count) % 2 == 0, 3.83, -1.17)


def white(count: int) -> Array:
    return np.random.default_rng(1).normal(0.0, 0.15, count)


def resonant(count: int) -> Array:
    """Noise through a loop with a damping of 0.2 at 40 Hz."""
    pole = np.exp(2e-3 * np.pi * 40.0 * (-0.2 + 1j))
    drive = np.random.default_rng(2).normal(0.0, 1.0, count + 500)
    state, found = 0.0 + 0.0j, []
    for each in drive:
        state = pole * state + each
        found.append(state.real)
    settled = np.array(found[500:])
    scaled: Array = 0.2 / settled.std() * settled
    return scaled


def test_the_limit_cycle_of_a_design_for_another_current_loop_is_told() -> None:
    meter = meter_of(rows_with(alternating(COUNT)))
    assert meter.worst.value == pytest.approx(2.5)
    (swing,) = meter.take_swings()
    assert swing.rms_nm == pytest.approx(2.5)
    assert swing.frequency_hz == pytest.approx(500.0)
    assert swing.at == SETTLING + (BLOCK - 1) * NS_PER_MS
    assert meter.take_swings() == [], "once for each time between two changes"


@pytest.mark.parametrize("frequency_hz", [33.3, 61.0, 203.1, 333.3])
def test_a_sine_of_any_frequency_is_one_line(frequency_hz: float) -> None:
    torque = 0.2 * np.sin(2e-3 * np.pi * frequency_hz * np.arange(COUNT))
    (swing,) = meter_of(rows_with(torque)).take_swings()
    assert swing.frequency_hz == pytest.approx(frequency_hz, abs=1.0)
    assert swing.share > 0.99


@pytest.mark.parametrize("noise", [white, resonant])
def test_noise_is_no_limit_cycle(noise: Callable[[int], Array]) -> None:
    torque = noise(100_000)
    meter = meter_of(rows_with(torque))
    assert meter.worst.value is not None
    assert meter.worst.value > 0.05 * RATED_NM, "it is large enough to be looked at"
    assert meter.take_swings() == []


def test_a_limit_cycle_broken_by_losses_is_told_by_its_size() -> None:
    torque = np.random.default_rng(3).choice([-1.5, 1.5], COUNT)
    (swing,) = meter_of(rows_with(torque)).take_swings()
    assert swing.share < 0.5


def test_what_is_too_small_to_matter_is_not_told() -> None:
    meter = meter_of(rows_with(0.02 * alternating(COUNT)))
    assert meter.worst.value == pytest.approx(0.05)
    assert meter.take_swings() == []


def test_nothing_counts_before_reference_and_load_have_settled() -> None:
    torque = np.concatenate([alternating(500), np.zeros(500)])
    reference = [0.0] * 300 + [100.0] * 700
    meter = meter_of(rows_with(torque, reference=reference))
    assert meter.worst.value == 0.0
    meter = meter_of(rows_with(torque, load=[0.0] * 260 + [0.6] * 740))
    assert meter.worst.value == 0.0
    ramp = np.linspace(0.0, 100.0, COUNT).tolist()
    assert meter_of(rows_with(alternating(COUNT), reference=ramp)).worst.value is None


def test_a_load_that_is_slowly_taken_up_is_no_swing() -> None:
    meter = meter_of(rows_with(np.linspace(0.0, 0.4, 4_000)))
    assert meter.worst.value is not None
    assert meter.worst.value < 0.004


def test_cycles_without_a_command_are_left_out() -> None:
    rows = rows_with(alternating(COUNT))
    rows["command_torque_nm"][::7], rows["command_expires_at"][::7] = np.nan, NOTHING
    assert meter_of(rows).worst.value == pytest.approx(2.5, rel=0.01)


def test_the_figures_do_not_depend_on_the_chunks() -> None:
    rows = rows_with(np.concatenate([white(700), 0.1 * alternating(1_300)]), load=[0.0] * 700 + [0.6] * 1_300)
    whole = meter_of(rows)
    told = whole.take_swings()
    assert len(told) == 1, "by its line, as it is smaller than noise may be"
    for size in (1, 37, 128, 700, 1_999):
        parts = meter_of(*(rows[place : place + size] for place in range(0, rows.size, size)))
        assert parts.worst.value == whole.worst.value
        assert parts.take_swings() == told


def test_a_review_tells_it_as_an_event() -> None:
    review = Review(ReviewPlan((AXIS,)))
    review.add(rows_with(alternating(COUNT)))
    (event,) = review.take_events()
    assert event.level == "WARN"
    assert "axis1: the torque swings by 2.5 N m rms" in event.text
    assert "limit cycle" in event.text
    assert review.figures().torque_rms_nm == pytest.approx(2.5)
    assert review.take_events() == []
