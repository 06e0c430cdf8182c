"""Certified peaks over lost readings and commands, beside every sequence of them, by another simulation."""

import itertools
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.design.errors import NoSolution
from servobench.design.sampled.loss_peak import losses_peak
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.speed.predictor_peaks import predictor_peak
from servobench.design.speed.random_loops import RandomPredictor
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.studies.speed.random_losses import Designed, remembering_of
from tests.benchmarks.bench_random_losses import Host
from tests.draws import few_of

pytestmark = pytest.mark.long

PERIODS, BEFORE = 10, 3


def path_of(kind: str) -> Path:
    return Path(f"examples/controllers/ling2012-{kind}.toml")


def certified(kind: str, readings: int, commands: int = 0) -> PeakBound:
    controller = load_controller(path_of(kind))
    assert isinstance(controller, Designed)
    remembering = remembering_of(controller, path_of(kind), 1.0)
    if isinstance(remembering, RandomPredictor):
        own = remembering
        return predictor_peak(own.loop, own.kalman, own.walks, readings, commands)
    return losses_peak(remembering, readings, commands)


def sequences(most: int) -> np.ndarray:
    """Every sequence (N, periods) of losses, at most so many in a row."""
    every = np.array(list(itertools.product((False, True), repeat=PERIODS if most else 1)))
    if not most:
        return np.zeros((1, PERIODS), dtype=bool)
    run, worst = np.zeros(len(every), dtype=int), np.zeros(len(every), dtype=int)
    for column in every.T:
        run = np.where(column, run + 1, 0)
        worst = np.maximum(worst, run)
    return every[worst <= most]


def largest(kind: str, readings: int, commands: int, load_nm: float = 0.6) -> float:
    """The largest error per N m of every sequence, the load coming at five instants of a period."""
    pairs = list(itertools.product(sequences(readings), sequences(commands)))
    missing, unheard = (np.array(each) for each in zip(*pairs, strict=True))
    file = tomllib.loads(path_of(kind).read_text(encoding="utf-8"))["controller"]
    return max(simulated(file, missing, unheard, part, load_nm) for part in (0.0, 0.2, 0.5, 0.8)) / load_nm


def simulated(
    file: dict[str, Any], missing: np.ndarray, unheard: np.ndarray, part: float, load_nm: float
) -> float:
    """The load comes ``part`` of a period after the sample of period ``BEFORE``."""
    runs = len(missing)
    host, peak = Host(file, runs), 0.0
    x, force, h = np.zeros((runs, 4)), np.zeros(runs), host.period_s
    instants = sorted({h * k / 24 for k in range(1, 25)} | {host.acts_s, part * h} - {0.0})
    for number in range(PERIODS + BEFORE + 1):
        at = number - BEFORE - 1
        lost = missing[:, at] if at >= 0 else np.zeros(runs, dtype=bool)
        host.decide(x, lost)
        acting = np.where(unheard[:, at] if at >= 0 else False, force, host.sent[host.behind])
        host.follow()
        at_s = 0.0
        if host.acts_s == 0.0:
            force = acting
        for instant in instants:
            begun = at >= 0 or (at == -1 and instant > part * h + 1e-12)
            x = host.plant.run(x, force, np.full(runs, load_nm * begun), instant - at_s)
            at_s = instant
            if instant == host.acts_s:
                force = acting
            peak = max(peak, float(np.abs(x[:, 1]).max()))
    return peak


@pytest.mark.parametrize(
    ("kind", "readings", "commands"),
    few_of(
        [
            ("hinf", 1, 0),
            ("predictor", 1, 0),
            ("fused", 1, 1),
            ("fused", 0, 0),
            ("fused", 1, 0),
            ("fused", 2, 0),
        ],
        3,
    ),
)
def test_no_sequence_exceeds_what_is_certified(kind: str, readings: int, commands: int) -> None:
    bound = certified(kind, readings, commands)
    seen = largest(kind, readings, commands)
    assert seen <= bound.certified
    assert bound.reached <= bound.certified < 1.02 * bound.reached
    assert seen > 0.97 * bound.reached


def test_where_losses_destabilise_nothing_is_certified() -> None:
    with pytest.raises(NoSolution, match="fall along every sequence"):
        certified("hinf", 2)
