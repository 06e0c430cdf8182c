"""What the drive tells of its state, held against exact fractions."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.virtual_bus.core.native import InnerLoops, clipped, user_position
from tests.draws import examples_of

FINITE = st.floats(allow_nan=False, allow_infinity=False)
HALVES = st.integers(-(1 << 34), 1 << 34).map(lambda twice: twice / 2)
FACTORS = st.sampled_from([1.0, -1.0, 0.5, -4.0, 182.04444, 1e-4])


def nearest(value: float) -> int:
    """Of two the even one, by exact arithmetic."""
    return round(Fraction(value))


@examples_of(500)
@given(FINITE | HALVES, st.sampled_from([8, 16, 32]))
def test_a_number_is_rounded_into_its_bits(value: float, bits: int) -> None:
    most = (1 << (bits - 1)) - 1
    assert clipped(value, bits) == min(max(nearest(value), -most - 1), most)


@examples_of(500)
@given(FINITE | HALVES, FACTORS)
def test_a_position_wraps_as_integer32(counts: float, factor: float) -> None:
    units = counts / factor
    if math.isinf(units):
        return
    position = user_position(counts, factor)
    assert -(1 << 31) <= position < 1 << 31
    assert (position - nearest(units)) % (1 << 32) == 0


def test_actual_values_are_in_the_units_of_the_master() -> None:
    inner = InnerLoops()
    inner.count, inner.origin, inner.counts_per_position = 1_000.0, 250.0, -2.0
    inner.speed_measured_rad_s, inner.velocity_per_rad_s = 10.0, 1e9
    inner.torque_measured_nm, inner.torque_unit_nm = 0.5, 0.2
    inner.limited = 1.0
    assert (inner.position_told(), inner.velocity_told(), inner.torque_told()) == (-375, 0x7FFF_FFFF, 2)
    assert inner.is_limited()
    assert inner.torque_demand_told() == 0


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("count", "position_told"),
        ("speed_measured_rad_s", "velocity_told"),
        ("torque_measured_nm", "torque_told"),
    ],
)
def test_a_state_that_is_no_number_is_an_error(name: str, told: str) -> None:
    inner = InnerLoops()
    setattr(inner, name, math.nan)
    with pytest.raises(ValueError, match="no number"):
        getattr(inner, told)()


def test_bits_are_at_most_those_of_an_object() -> None:
    with pytest.raises(ValueError, match="33 bits"):
        clipped(1.0, 33)
