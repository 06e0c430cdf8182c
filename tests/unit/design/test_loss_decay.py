"""Certified decays over lost readings and commands, beside all short patterns in another simulation."""

import itertools
import tomllib

import numpy as np
import pytest

from servobench.design.errors import NoSolution
from servobench.design.sampled.loss_decay import DecayPerSecond
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.studies.speed.loss_peaks import decay_of
from servobench.hil.studies.speed.random_losses import Designed, remembering_of
from tests.benchmarks.bench_random_losses import Host
from tests.draws import few_of
from tests.unit.design.test_loss_peak import path_of

pytestmark = pytest.mark.long

LENGTH, WINDOW = 7, 240
"""Periods of the longest pattern tried, and of each of three parts of a run; in the first it settles."""


def certified(
    kind: str, readings: int, commands: int, inertias: tuple[float, float] = (1.0, 1.0)
) -> DecayPerSecond:
    controller = load_controller(path_of(kind))
    assert isinstance(controller, Designed)
    return decay_of(remembering_of(controller, path_of(kind), 1.0), readings, commands, inertias)


def closed(pattern: tuple[bool, ...], most: int) -> bool:
    """Whether no more than ``most`` are lost in a row, the pattern being repeated."""
    runs = "".join("x" if lost else " " for lost in pattern * 3).split()
    return max(map(len, runs), default=0) <= most


def slowest(kind: str, readings: int, commands: int) -> float:
    """The slowest decay of all patterns of up to :data:`LENGTH` periods, 1/s."""
    file = tomllib.loads(path_of(kind).read_text(encoding="utf-8"))["controller"]
    rates = []
    for length in range(1, LENGTH + 1):
        every = list(itertools.product((False, True), repeat=length))
        pairs = itertools.product(
            (each for each in every if closed(each, readings)),
            [each for each in every if closed(each, commands)] if commands else [(False,) * length],
        )
        missing, unheard = (np.array(each) for each in zip(*pairs, strict=True))
        rates.append(decays(file, missing, unheard).min())
    return float(min(rates))


def decays(file: dict[str, object], missing: np.ndarray, unheard: np.ndarray) -> np.ndarray:
    """The rates (runs,) at which shafts that were pushed come to rest under patterns (runs, periods)."""
    runs, length = missing.shape
    host, h = Host(file, runs), 0.001
    draw = np.random.default_rng(40)
    x, force, none = draw.normal(size=(runs, 4)), np.zeros(runs), np.zeros(runs)
    sizes = []
    for number in range(3 * WINDOW):
        # the angle does not return, and would hide small speeds behind its rounding
        host.x[:, 3], x[:, 3] = host.x[:, 3] - x[:, 3], 0.0
        host.decide(x, missing[:, number % length])
        acting = np.where(unheard[:, number % length], force, host.sent[host.behind])
        host.follow()
        x = host.plant.run(x, force, none, host.acts_s) if host.acts_s else x
        x = host.plant.run(x, acting, none, h - host.acts_s)
        force = acting
        sizes.append(np.abs(x[:, :3]).max(axis=1))
    _, early, late = np.array(sizes).reshape(3, WINDOW, runs).max(axis=1)
    return np.asarray(np.log(early / late) / (h * WINDOW))


@pytest.mark.parametrize(
    ("kind", "readings", "commands"), few_of([("hinf", 1, 0), ("fused", 1, 1), ("fused", 1, 0)], 2)
)
def test_no_pattern_is_slower_than_what_is_certified(kind: str, readings: int, commands: int) -> None:
    bound, found = certified(kind, readings, commands)
    seen = slowest(kind, readings, commands)
    assert bound <= found
    assert bound > 0.95 * found
    assert seen > 0.99 * bound
    assert seen == pytest.approx(found, rel=0.03)


def test_a_range_of_inertias_is_as_slow_as_its_slowest() -> None:
    bound, found = certified("hinf", 0, 0, inertias=(0.7, 1.3))
    each = [certified("hinf", 0, 0, inertias=(one, one))[1] for one in (0.7, 1.0, 1.3)]
    assert 0.95 * found < bound <= found
    assert found == pytest.approx(min(each), rel=1e-3)
    assert max(each) > 1.5 * min(each)


def test_where_a_pattern_destabilises_nothing_is_certified() -> None:
    with pytest.raises(NoSolution, match="a pattern is known that destabilises"):
        certified("hinf", 2, 0)
