"""Whether a measurement's PDOs fit on the bus: at what share of it, and what is told if they do not."""

import math
import re
from dataclasses import replace

import pytest

from servobench.drivers.canopen.pdo_budget import LOAD_LIMIT_PERCENT
from servobench.drivers.errors import BadInput
from servobench.hil.measuring.subject import MeasureRequest, affordable

ASKED = MeasureRequest("hub:x", (1,), 1000, 1000, 1_000_000, enable=False, speed_max_rad_s=10.0)
SHORTEST = 250
"""Of the option --period-us."""


@pytest.mark.parametrize("enable", [False, True])
@pytest.mark.parametrize("nodes", [(1, 2), (1, 2, 3, 4, 5), tuple(range(1, 13))])
def test_what_is_refused_names_the_shortest_period_that_is_not(enable: bool, nodes: tuple[int, ...]) -> None:
    asked = replace(ASKED, enable=enable, nodes=nodes, bitrate_bit_s=250_000)
    with pytest.raises(BadInput, match=f"{LOAD_LIMIT_PERCENT:g} % of the bus") as caught:
        affordable(replace(asked, period_us=SHORTEST))
    assert (caught.value.source, caught.value.value) == ("--period-us", SHORTEST)
    (told,) = re.findall(r"at least (\d+),", caught.value.expected)
    affordable(replace(asked, period_us=int(told)))
    with pytest.raises(BadInput):
        affordable(replace(asked, period_us=math.floor(0.99 * int(told))))


@pytest.mark.long
def test_with_less_room_the_position_comes_seldom_before_anything_is_refused() -> None:
    told = []
    for period_us in range(20_000, SHORTEST, -50):
        try:
            told.append(
                affordable(replace(ASKED, nodes=(1, 2, 3), period_us=period_us, bitrate_bit_s=125_000))
            )
        except BadInput:
            break
    assert list(dict.fromkeys(told)) == [(False, 1), (False, 4), (False, 10)]


@pytest.mark.long
def test_drives_that_follow_torques_tell_them_on_change_where_there_is_room() -> None:
    told = []
    for period_us in range(20_000, SHORTEST, -50):
        try:
            asked = replace(ASKED, nodes=(1, 2, 3), period_us=period_us, bitrate_bit_s=125_000, enable=True)
            told.append(affordable(asked))
        except BadInput:
            break
    assert list(dict.fromkeys(told)) == [(True, 1), (False, 1)]
