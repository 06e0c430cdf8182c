"""Certified gains over lost readings and commands and over inertias, beside another simulation."""

import itertools
import math
import tomllib
from typing import Any

import numpy as np

from servobench.design.sampled.loss_gain import GainBound
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.studies.speed.loss_peaks import gain_of
from servobench.hil.studies.speed.random_losses import Designed, remembering_of
from tests.benchmarks.bench_random_losses import Host, Physics
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


def certified(
    kind: str, readings: int, commands: int, inertias: tuple[float, float] = (1.0, 1.0)
) -> GainBound:
    controller = load_controller(path_of(kind))
    assert isinstance(controller, Designed)
    return gain_of(remembering_of(controller, path_of(kind), 1.0), readings, commands, inertias)


def gain(
    file: dict[str, Any],
    pattern: tuple[bool, ...],
    periods: int,
    unheard: tuple[bool, ...] = (False,),
    inertia: float = 1.0,
) -> float:
    """The largest singular value of the map from pulses of the load to the speed, over so many periods.

    ``unheard``: pattern of lost commands; ``inertia``: multiple of the controller's.
    """
    runs = periods * PULSES
    host = Host(file, runs)
    plant, hz = file["made_for"]["plant"], file["made_for"]["current_loop"]["bandwidth_hz"]
    shaft = Physics(
        inertia * plant["inertia_kg_m2"], plant["viscous_friction_nm_s"], math.tau * hz, math.tau * 500.0
    )
    tick_s = host.period_s / TICKS
    acting = round(host.acts_s / tick_s)
    assert abs(acting * tick_s - host.acts_s) < 1e-9
    x, force, seen = np.zeros((runs, 4)), np.zeros(runs), []
    pulses = np.arange(runs)
    for period in range(periods):
        host.decide(x, np.full(runs, pattern[period % len(pattern)]))
        host.follow()
        for tick in range(TICKS):
            if tick == acting and not unheard[period % len(unheard)]:
                force = host.sent[host.behind]
            load = 1.0 * (pulses == PULSES * period + tick * PULSES // TICKS)
            x = shaft.run(x, force, load, tick_s)
            seen.append(x[:, 1])
    return float(np.linalg.norm(np.array(seen), 2)) * float(np.sqrt(PULSES / TICKS))


def test_no_pattern_has_a_larger_gain_than_the_file_of_hinf_is_certified_for() -> None:
    """The longer a pattern lasts, the nearer it comes to the bound."""
    file = tomllib.loads(path_of("hinf").read_text(encoding="utf-8"))["controller"]
    bound = file["certificate"]["sequences"]["gain_certified"]
    assert largest_gain(file, 1, 5) <= bound
    assert 0.97 * bound < gain(file, (False, False, True, False), 144) <= bound


def test_a_range_of_inertias_has_the_gain_of_its_worst_and_bounds_what_lies_between() -> None:
    file = tomllib.loads(path_of("hinf").read_text(encoding="utf-8"))["controller"]
    bound, found = certified("hinf", 0, 0, (0.7, 0.8))
    seen = [gain(file, (False,), 120, inertia=inertia) for inertia in (0.7, 0.75, 0.8)]
    assert found <= bound < 1.05 * found
    assert max(seen) <= found
    assert max(seen) > 0.95 * found
    assert max(seen[1:]) < 0.9 * max(seen)


def test_lost_commands_count_as_well() -> None:
    """A lost command leaves the drive with the one before, which costs more than a lost reading."""
    file = tomllib.loads(path_of("fused").read_text(encoding="utf-8"))["controller"]
    bound, found = certified("fused", 0, 1)
    patterns = [each for each in itertools.product((False, True), repeat=4) if closed(each, 1)]
    seen = max(gain(file, (False,), 30, unheard=each) for each in patterns)
    assert 0.85 * found < seen <= found <= bound < 1.1 * found
    assert found > 1.5 * certified("fused", 0, 0).found
