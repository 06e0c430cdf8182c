"""Position set-points of limited speed and acceleration, whatever is asked for."""

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servobench.hil.loop.safety import PositionPath

PERIOD_S = 0.001
RATE, ACCELERATION = 50.0, 2000.0


def path_after(demands: list[float], acceleration: float | None = ACCELERATION) -> list[float]:
    path = PositionPath(RATE, acceleration, PERIOD_S)
    path.start_from(0.0)
    return [0.0, 0.0, *(path.towards(demand) for demand in demands)]


@settings(derandomize=True, deadline=None)
@given(st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=50), st.integers(1, 20))
def test_no_demand_makes_it_faster_or_jerkier_than_its_limits(levels: list[float], held: int) -> None:
    found = path_after([level for level in levels for _ in range(held)])
    steps = [b - a for a, b in itertools.pairwise(found)]
    changes = [b - a for a, b in itertools.pairwise(steps)]
    assert max(map(abs, steps)) <= RATE * PERIOD_S * (1.0 + 1e-9)
    assert max(map(abs, changes)) <= ACCELERATION * PERIOD_S**2 * (1.0 + 1e-6)


@pytest.mark.parametrize("level", [0.01, 0.5, -4.0])
def test_a_step_ends_where_it_was_to_end_and_never_beyond(level: float) -> None:
    found = path_after([level] * 300)
    assert found[-1] == level
    assert max(map(abs, found)) <= abs(level) * (1.0 + 1e-12)
    # rest to rest: as long as a trapezoid takes, but for the last periods
    way = abs(level)
    shortest_s = (
        2.0 * math.sqrt(way / ACCELERATION)
        if way < RATE**2 / ACCELERATION
        else way / RATE + RATE / ACCELERATION
    )
    reached_s = next(place for place, at in enumerate(found) if at == level) * PERIOD_S
    assert shortest_s - 1e-9 <= reached_s <= shortest_s + 0.012


def test_a_demand_within_the_limits_passes_through_bit_by_bit() -> None:
    demands = [0.5 * math.sin(math.tau * 5.0 * number * PERIOD_S) for number in range(1, 400)]
    # begin at rest: the sine's own speed is jumped to, caught up with, and then kept
    assert path_after(demands)[2 + 100 :] == demands[100:]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_without_a_limit_of_acceleration_the_rate_alone_is_held(sign: float) -> None:
    found = path_after([sign] * 30, acceleration=None)
    assert found[2:] == pytest.approx([sign * min(1.0, RATE * PERIOD_S * number) for number in range(1, 31)])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_demand_at_its_very_limits_passes_through(sign: float) -> None:
    """Binary fractions, so that nothing is rounded: 2**-9 rad faster each period, up to 2**-4 rad."""
    path = PositionPath(64.0, 2048.0, 2.0**-10)
    steps = [sign * min(number, 32) * 2.0**-9 for number in range(1, 50)]
    demands = list(itertools.accumulate(steps))
    assert [path.towards(demand) for demand in demands] == demands


@pytest.mark.parametrize("offset", [1.0, -1.0])
def test_a_demand_that_moves_is_caught_up_with_as_soon_as_the_limits_allow(offset: float) -> None:
    """A jump of 1 rad onto a ramp: at best bang and bang in the ramp's own frame, from its rate behind."""
    rate = 10.0
    demands = [offset + rate * PERIOD_S * number for number in range(600)]
    found = path_after(demands)[2:]
    caught = next(place for place, pair in enumerate(zip(found, demands, strict=True)) if pair[0] == pair[1])
    assert found[caught:] == demands[caught:]
    # the way to make up begins at a relative speed of -rate, and ends at none
    slower, ahead = rate / ACCELERATION, offset + 0.5 * rate**2 / ACCELERATION
    top = math.sqrt(abs(ahead) * ACCELERATION)
    room = RATE - rate if ahead > 0.0 else RATE + rate
    best_s = slower if offset > 0.0 else -slower
    best_s += 2.0 * top / ACCELERATION if top < room else abs(ahead) / room + room / ACCELERATION
    assert best_s - PERIOD_S <= caught * PERIOD_S <= best_s + 0.015
    steps = [b - a for a, b in itertools.pairwise([0.0, *found])]
    assert max(map(abs, steps)) <= RATE * PERIOD_S * (1.0 + 1e-9)


def test_a_path_begins_anew_at_rest() -> None:
    path = PositionPath(RATE, ACCELERATION, PERIOD_S)
    for number in range(40):
        path.towards(0.04 * number)
    path.start_from(3.0)
    assert path.towards(4.0) == pytest.approx(3.0 + ACCELERATION * PERIOD_S**2)
    path.start_from(3.0)
    assert [path.towards(3.0) for _ in range(3)] == [3.0] * 3


def test_after_what_is_no_number_it_begins_at_rest() -> None:
    path = PositionPath(RATE, ACCELERATION, PERIOD_S)
    for _ in range(20):
        path.towards(4.0)
    held = path.towards(math.nan)
    assert path.towards(4.0) == pytest.approx(held + ACCELERATION * PERIOD_S**2)


def test_what_is_no_number_leaves_it_where_it_is() -> None:
    path = PositionPath(RATE, None, PERIOD_S)
    path.start_from(3.0)
    assert path.towards(math.nan) == 3.0
    assert path.towards(3.01) == 3.01
