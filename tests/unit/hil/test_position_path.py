"""Position set-points of limited speed and acceleration, whatever is asked for."""

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.loop.position_path import PositionPath

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


def test_without_a_limit_of_acceleration_the_rate_alone_is_held() -> None:
    found = path_after([1.0] * 30, acceleration=None)
    assert found[2:] == pytest.approx([min(1.0, RATE * PERIOD_S * number) for number in range(1, 31)])


def test_what_is_no_number_leaves_it_where_it_is() -> None:
    path = PositionPath(RATE, None, PERIOD_S)
    path.start_from(3.0)
    assert path.towards(math.nan) == 3.0
    assert path.towards(3.01) == 3.01
