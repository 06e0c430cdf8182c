"""The core's rounding against Python's own."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.core.native import nearest
from tests.draws import examples_of


@examples_of(100)
@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers(-1000, 1000).map(lambda k: k + 0.5))
def test_to_the_nearest_of_two_the_even_one(value: float) -> None:
    assert nearest(value) == round(value)


def test_what_is_not_finite_has_the_error_of_round() -> None:
    with pytest.raises(ValueError, match="NaN"):
        nearest(math.nan)
    for infinite in (math.inf, -math.inf):
        with pytest.raises(OverflowError, match="infinity"):
            nearest(infinite)
