"""Adaptive draws on functions whose failure probability is known in closed form, and their intervals."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import binom, norm

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.plan import NOMINAL_SHARE, Drawn, Rounds
from servobench.hil.campaign.statistics import ConfidenceInterval, weighted_rate
from servobench.hil.campaign.sweep_file import Adaptive, sweep_from

Floats = NDArray[np.float64]
RARE = 1e-3
ROUND, RUNS, TIMES = 100, 1_000, 40


def campaign(
    guide: Callable[[Floats], Floats],
    limit: float,
    keys: int,
    seed: int,
    focus: str = "failures",
    runs: int = RUNS,
) -> list[tuple[Drawn, bool]]:
    """All runs, with whether each failed: beyond ``limit``."""
    adaptive = Adaptive.model_validate({"guide": "g", "focus": focus, "round_runs": ROUND})
    rounds = Rounds(adaptive, np.random.default_rng(seed).random((runs, keys)), seed)
    done: list[tuple[Drawn, bool]] = []
    while len(done) < runs:
        drawn = [rounds.drawn(number) for number in range(len(done), rounds.known)]
        values = guide(ndtri(np.array([each.even for each in drawn])))
        rows = [
            {"run": len(done) + place, "g": float(value), "passed": bool(value <= limit)}
            for place, value in enumerate(values)
        ]
        done += [(each, bool(value > limit)) for each, value in zip(drawn, values, strict=True)]
        rounds.take(rows)
        rounds.take(rows[:3])
    return done


def rate_of(runs: list[tuple[Drawn, bool]]) -> ConfidenceInterval:
    counting = [(each.weight, failed) for each, failed in runs if each.counts]
    weights, failed = (np.array(column) for column in zip(*counting, strict=True))
    return weighted_rate(weights, failed.astype(bool), 0.95)


def diagonal(z: Floats) -> Floats:
    along: Floats = z.sum(axis=1) / np.sqrt(z.shape[1])
    return along


def either_side(z: Floats) -> Floats:
    """Two ways to fail, far from each other."""
    return np.abs(z[:, 0])


@pytest.mark.parametrize(
    ("guide", "keys", "limit"),
    [(diagonal, 2, norm.isf(RARE)), (either_side, 2, norm.isf(RARE / 2))],
)
def test_a_rare_failure_is_in_its_interval_as_often_as_it_says(
    guide: Callable[[Floats], Floats], keys: int, limit: float
) -> None:
    """And the estimate scatters a fifth of what as many plain draws would."""
    found = [rate_of(campaign(guide, limit, keys, seed)) for seed in range(TIMES)]
    inside = sum(each.low <= RARE <= each.high for each in found)
    assert inside >= binom.ppf(1e-3, TIMES, 0.95)
    estimates = np.array([each.estimate for each in found])
    plain = np.sqrt(RARE / RUNS)
    assert estimates.std() < 0.2 * plain
    assert abs(estimates.mean() - RARE) < 4.0 * estimates.std() / np.sqrt(TIMES) + 0.02 * RARE


def test_one_in_a_hundred_thousand_is_found_too() -> None:
    found = [rate_of(campaign(diagonal, norm.isf(1e-5), 3, seed, runs=1_600)) for seed in range(10)]
    assert np.mean([each.estimate for each in found]) == pytest.approx(1e-5, rel=0.2)
    assert max(each.high / each.low for each in found) < 3.0


def test_the_boundary_gets_more_runs_and_the_rate_stays_right() -> None:
    limit = norm.isf(0.2)
    near, plain, covered = 0, 0, 0
    for seed in range(40):
        runs = campaign(diagonal, limit, 2, seed, "boundary", 400)
        z = ndtri(np.array([each.even for each, _ in runs if each.counts]))
        near += int((np.abs(diagonal(z) - limit) < 0.3).sum())
        plain += len(z)
        rate = rate_of(runs)
        covered += rate.low <= 0.2 <= rate.high
    assert near / plain > 1.4 * (ndtr(limit + 0.3) - ndtr(limit - 0.3))
    assert covered >= binom.ppf(1e-3, 40, 0.95)


def test_no_weight_exceeds_one_over_the_nominal_share_and_their_mean_is_one() -> None:
    runs = campaign(diagonal, norm.isf(RARE), 2, 1, runs=4_000)
    weights = np.array([each.weight for each, _ in runs if each.counts])
    assert weights.max() <= 1.0 / NOMINAL_SHARE["failures"] * (1.0 + 1e-12)
    assert abs(weights.mean() - 1.0) < 5.0 * weights.std() / np.sqrt(weights.size)


def test_draws_are_a_function_of_the_rows_before_them() -> None:
    assert campaign(diagonal, 2.0, 2, 5) == campaign(diagonal, 2.0, 2, 5)
    assert [each for each, _ in campaign(diagonal, 2.0, 2, 5)[:ROUND]] == [
        each for each, _ in campaign(diagonal, 9.0, 2, 5)[:ROUND]
    ]


def test_without_a_failure_the_interval_is_that_of_the_heaviest_runs() -> None:
    none = weighted_rate(np.array([2.0] + [0.5] * 99), np.zeros(100, bool), 0.95)
    assert (none.estimate, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(2.0 * (1.0 - 0.025**0.01))
    assert weighted_rate(np.empty(0), np.empty(0, bool), 0.95).high == 1.0


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        ({"draw": []}, "draw: found 0"),
        ({"vary": [{"key": "a", "values": [1]}]}, "vary: found 1"),
        ({"drawing": {"method": "sobol"}, "campaign": {"seeds": 512}}, "drawing.method"),
        ({"stop": {"rate_width": 0.1}}, "stop.rate_width"),
        ({"campaign": {"seeds": 399}}, "campaign.seeds: found 399"),
    ],
)
def test_what_does_not_go_with_adaptive_draws_is_refused(tables: dict[str, object], told: str) -> None:
    base: dict[str, object] = {
        "draw": [{"key": "b", "distribution": "uniform", "low": 0.0, "high": 1.0}],
        "adaptive": {"guide": "speed_error_peak_percent"},
    }
    campaign_table = {"name": "x", "bench": "x.toml", "seeds": 500, **tables.pop("campaign", {})}  # type: ignore[dict-item]
    with pytest.raises(BadInput, match=told):
        sweep_from({**base, **tables, "campaign": campaign_table}, "sweep.toml")
