"""Patterns of deliveries and of periods are two ways to say the same."""

import random

import numpy as np
import pytest

from servobench.design.hinf.mixed_sensitivity import loop_functions
from servobench.design.sampled.admissible_steps import Delivery, deliveries_of, steps_of
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.statespace import StateSpace
from tests.draws import few_of

H = 0.01


def acting(deliveries: list[Delivery], at_s: float, rounds: int) -> int:
    """The sample that acts at an instant of a pattern that is repeated: the youngest that has come."""
    taken, youngest = 0, -1
    for delivery in deliveries * rounds:
        if taken * H + delivery.delay_s <= at_s:
            youngest = max(youngest, taken)
        taken += delivery.interval
    return youngest


@pytest.mark.parametrize("seed", few_of(range(4), 2))
def test_a_pattern_goes_there_and_back(seed: int) -> None:
    draw = random.Random(seed)
    for _ in range(40):
        pattern = [
            Delivery(draw.randint(1, 3), draw.uniform(1e-4, 0.9 * H)) for _ in range(draw.randint(1, 5))
        ]
        network = SampledNetwork(Strategy.ARRIVAL, H, 5, H, 0.0)
        found = list(deliveries_of(network, steps_of(network, pattern)))
        turns = [found[place:] + found[:place] for place in range(len(found))]
        assert any(
            [each.interval for each in turn] == [each.interval for each in pattern]
            and [each.delay_s for each in turn] == pytest.approx([each.delay_s for each in pattern])
            for turn in turns
        )


@pytest.mark.parametrize("seed", few_of(range(4), 2))
def test_what_is_overtaken_never_acts(seed: int) -> None:
    """Delays of several periods: at every instant the youngest sample that has come acts."""
    draw = random.Random(100 + seed)
    for _ in range(25):
        pattern = [Delivery(draw.randint(1, 2), draw.uniform(1e-4, 3.5 * H)) for _ in range(4)]
        network = SampledNetwork(Strategy.ARRIVAL, H, 5, 4 * H, 0.0)
        found = list(deliveries_of(network, steps_of(network, pattern)))
        total = sum(each.interval for each in pattern)
        assert sum(each.interval for each in found) == total
        assert len(found) <= len(pattern)
        instants = np.array([draw.uniform(20 * total * H, 24 * total * H) for _ in range(60)])
        ages = np.array([instant / H - acting(pattern, instant, 30) for instant in instants])
        shifts = range(total)
        told = [
            np.array([instant / H - acting(found, instant - shift * H, 30) - shift for instant in instants])
            for shift in shifts
        ]
        assert any(np.allclose(ages, each) for each in told)


def test_the_functions_of_a_loop_are_those_of_complex_numbers() -> None:
    """G = 2/(s + 3), K = 5 + 1/(s + 1)."""
    G = StateSpace(np.array([[-3.0]]), np.array([[1.0]]), np.array([[2.0]]), np.array([[0.0]]))
    K = StateSpace(np.array([[-1.0]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[5.0]]))
    w = np.geomspace(0.01, 1e3, 30)
    s = 1j * w
    g, k = 2.0 / (s + 3.0), 5.0 + 1.0 / (s + 1.0)
    found = loop_functions(G, K, w)
    assert found["S"] == pytest.approx(np.abs(1.0 / (1.0 + g * k)))
    assert found["KS"] == pytest.approx(np.abs(k / (1.0 + g * k)))
    assert found["T"] == pytest.approx(np.abs(g * k / (1.0 + g * k)))
