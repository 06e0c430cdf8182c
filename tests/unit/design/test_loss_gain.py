"""Certified gains over lost readings, beside all short patterns in another simulation."""

import itertools
import tomllib
from typing import Any

import numpy as np

from tests.benchmarks.bench_random_losses import Host
from tests.unit.design.test_loss_decay import closed
from tests.unit.design.test_loss_peak import path_of

TICKS, PULSES = 20, 4
"""Of a period: ticks, at whose ends the error is seen, and pulses of the load."""


def largest_gain(file: dict[str, Any], readings: int, length: int) -> float:
    """The largest gain of the patterns of up to ``length`` periods, rad/s per N m."""
    every = itertools.chain.from_iterable(
        itertools.product((False, True), repeat=periods) for periods in range(1, length + 1)
    )
    patterns = [each for each in every if closed(each, readings)]
    return max(gain(file, each, 36) for each in patterns)


def gain(file: dict[str, Any], pattern: tuple[bool, ...], periods: int) -> float:
    """The largest singular value of the map from pulses of the load to the speed, over so many periods."""
    runs = periods * PULSES
    host = Host(file, runs)
    tick_s = host.period_s / TICKS
    acting = round(host.acts_s / tick_s)
    assert abs(acting * tick_s - host.acts_s) < 1e-9
    x, force, seen = np.zeros((runs, 4)), np.zeros(runs), []
    pulses = np.arange(runs)
    for period in range(periods):
        host.decide(x, np.full(runs, pattern[period % len(pattern)]))
        host.follow()
        for tick in range(TICKS):
            if tick == acting:
                force = host.sent[host.behind]
            load = 1.0 * (pulses == PULSES * period + tick * PULSES // TICKS)
            x = host.plant.run(x, force, load, tick_s)
            seen.append(x[:, 1])
    return float(np.linalg.norm(np.array(seen), 2)) * float(np.sqrt(PULSES / TICKS))


def test_no_pattern_has_a_larger_gain_than_the_file_of_hinf_is_certified_for() -> None:
    """The longer a pattern lasts, the nearer it comes to the bound."""
    file = tomllib.loads(path_of("hinf").read_text(encoding="utf-8"))["controller"]
    bound = file["certificate"]["sequences"]["gain_certified"]
    assert largest_gain(file, 1, 5) <= bound
    assert 0.97 * bound < gain(file, (False, False, True, False), 144) <= bound
