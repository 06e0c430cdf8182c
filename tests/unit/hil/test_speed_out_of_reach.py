"""A gain that is out of reach: what is the best there is, and what would do instead."""

import pytest

from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.hil.studies.speed.synthesis import Unreachable
from tests.unit.hil.made_analyses import STAMP
from tests.unit.hil.test_speed_synthesis import design, percent, request


def unreachable(
    needed_s: float | None, network: SampledNetwork | None, *, for_sampled: bool = False
) -> Unreachable:
    return Unreachable(request(20.0, network=network, for_sampled=for_sampled), design(80.0, 0.05), needed_s)


@pytest.mark.parametrize(
    ("needed_s", "losses_max", "period_s", "losses"),
    [
        (0.034, 2, 0.01, 2),
        (0.0339999, 2, 0.0299999 / 3, 1),
        (0.024, 1, 0.01, 1),
        (0.014, 2, 0.01 / 3, 0),
        (0.0139, 2, 0.0099 / 3, None),
        (0.004, 2, None, None),
        (0.001, 2, None, None),
    ],
)
def test_what_is_out_of_reach_tells_what_would_do(
    needed_s: float, losses_max: int, period_s: float | None, losses: int | None
) -> None:
    """A sample is as old as its delay of 4 ms and one period of 10 ms more than were lost."""
    network = SampledNetwork(Strategy.ARRIVAL, 0.01, losses_max, 0.004)
    assert unreachable(needed_s, network).figures == {
        "feasible": False,
        "method": "exact",
        "demand": {"gamma": 20.0, "delay_s": 0.05, "error_percent": pytest.approx(percent(20.0))},
        "best": {
            "gain": [0.0, -0.02],
            "gamma": 80.0,
            "delay_s": 0.05,
            "error_percent": pytest.approx(percent(80.0)),
        },
        "would_do": {
            "load_nm": pytest.approx(0.125),
            "delay_s": needed_s,
            "period_s": None if period_s is None else pytest.approx(period_s),
            "loss_max": losses,
        },
    }


@pytest.mark.parametrize(("needed_s", "network"), [(None, STAMP), (0.03, None)])
def test_without_a_network_or_a_delay_nothing_of_it_would_do(
    needed_s: float | None, network: SampledNetwork | None
) -> None:
    do = unreachable(needed_s, network).figures["would_do"]
    assert do == {"load_nm": pytest.approx(0.125), "delay_s": needed_s}


HEAD = (
    "25 % of the speed (20 rad/s per N m) is out of reach at a delay of 50 ms by the method exact; the best "
    "is 100 % of the speed (80 rad/s per N m); what would do: a load step of at most 0.125 N m instead of 0.5"
)
SAMPLED = "perhaps --target sampled, which makes the loop best that really runs"


@pytest.mark.parametrize(
    ("needed_s", "network", "for_sampled", "more"),
    [
        (None, None, False, []),
        (0.03, None, False, ["a delay of at most 30 ms"]),
        (None, STAMP, False, [SAMPLED]),
        (None, STAMP, True, []),
        (0.003, STAMP, True, ["a delay of at most 3 ms"]),
        (
            0.034,
            STAMP,
            False,
            [
                "a delay of at most 34 ms",
                "a period of at most 10 ms with the same losses",
                "at most 2 losses in a row at the same period",
                SAMPLED,
            ],
        ),
    ],
)
def test_what_is_out_of_reach_is_told_in_a_sentence(
    needed_s: float | None, network: SampledNetwork | None, for_sampled: bool, more: list[str]
) -> None:
    error = unreachable(needed_s, network, for_sampled=for_sampled)
    assert str(error) == ", or ".join([HEAD, *more])
