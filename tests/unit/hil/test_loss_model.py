"""The loss model: its likelihood against a sum over all paths, its parameters against those simulated."""

from itertools import product

import numpy as np
import pytest

from servobench.hil.measuring.loss_model import (
    CAME,
    LOST,
    UNKNOWN,
    Outcomes,
    Parameters,
    Runs,
    fit,
    losses_of,
)


def chain(truth: Parameters, frames: int, seed: int) -> Outcomes:
    """What a link of these parameters loses, frame by frame, as servobench.virtual_bus.faults does it."""
    random = np.random.default_rng(seed)
    moves, strikes = random.random(frames), random.random(frames)
    outcomes = np.zeros(frames, np.int8)
    bad = False
    for frame in range(frames):
        bad = moves[frame] >= truth.p_bad_to_good if bad else moves[frame] < truth.p_good_to_bad
        outcomes[frame] = strikes[frame] < (truth.loss_bad if bad else truth.loss_good)
    return outcomes


def over_all_paths(outcomes: list[int], truth: Parameters) -> float:
    """The probability of the outcomes, summed over every sequence of states."""
    up, down, loss_bad, loss_good = truth
    total = 0.0
    for path in product((False, True), repeat=len(outcomes) + 1):
        chance = truth.share_bad if path[0] else 1.0 - truth.share_bad
        for before, state, outcome in zip(path, path[1:], outcomes, strict=False):
            if before:
                chance *= 1.0 - down if state else down
            else:
                chance *= up if state else 1.0 - up
            loss = loss_bad if state else loss_good
            chance *= {CAME: 1.0 - loss, LOST: loss, UNKNOWN: 1.0}[outcome]
        total += chance
    return total


@pytest.mark.parametrize(
    "outcomes",
    [
        [CAME],
        [LOST, LOST, LOST],
        [CAME, CAME, CAME, LOST, CAME, LOST, LOST, CAME, CAME],
        [UNKNOWN, LOST, UNKNOWN, UNKNOWN, CAME, LOST, CAME],
    ],
)
@pytest.mark.parametrize("truth", [Parameters(0.1, 0.4, 0.9, 0.05), Parameters(0.02, 0.3)])
def test_the_likelihood_is_the_sum_over_all_paths(outcomes: list[int], truth: Parameters) -> None:
    found = Runs(np.array(outcomes, np.int8)).log_likelihood(truth)
    assert np.exp(found) == pytest.approx(over_all_paths(outcomes, truth), rel=1e-12)


@pytest.mark.parametrize(
    ("truth", "free"),
    [
        (Parameters(0.01, 0.3), 2),
        (Parameters(0.01, 0.2, 0.7), 3),
        (Parameters(0.01, 0.1, 0.8, 0.01), 4),
    ],
)
def test_a_chain_is_found_again(truth: Parameters, free: int) -> None:
    found = fit(chain(truth, 40_000, seed=5))
    assert not found.independent
    assert list(found.intervals) == list(Parameters._fields[:free])
    for name, interval in found.intervals.items():
        value = getattr(found.parameters, name)
        assert value == pytest.approx(getattr(truth, name), rel=0.2)
        assert interval.low < value < interval.high
    assert found.parameters[free:] == (1.0, 0.0)[free - 2 :]


@pytest.mark.long
def test_the_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    truth = Parameters(0.02, 0.25)
    held = [
        interval.low <= getattr(truth, name) <= interval.high
        for seed in range(30)
        for name, interval in fit(chain(truth, 6000, seed)).intervals.items()
        if name in ("p_good_to_bad", "p_bad_to_good")
    ]
    assert len(held) == 60
    assert 0.88 <= np.mean(held) <= 1.0  # 95 % of 60: below 53 once in a thousand


@pytest.mark.long
def test_losses_without_memory_are_called_independent() -> None:
    truth = Parameters(0.0, 1.0, 1.0, 0.1)
    found = fit(chain(truth, 10_000, seed=1))
    assert found.independent
    low, high = found.intervals["probability"]
    assert low < 0.1 < high
    assert found.parameters.loss == pytest.approx(0.1, abs=0.01)


@pytest.mark.long
def test_frames_of_unknown_fate_change_nothing_but_the_certainty() -> None:
    truth = Parameters(0.02, 0.3)
    outcomes = chain(truth, 40_000, seed=2)
    whole = fit(outcomes)
    outcomes[np.random.default_rng(0).random(outcomes.size) < 0.4] = UNKNOWN
    found = fit(outcomes)
    for name in ("p_good_to_bad", "p_bad_to_good"):
        assert getattr(found.parameters, name) == pytest.approx(getattr(truth, name), rel=0.2)
        wide, narrow = found.intervals[name], whole.intervals[name]
        assert wide.high - wide.low > narrow.high - narrow.low


@pytest.mark.parametrize("truth", [Parameters(0.02, 0.25), Parameters(0.05, 0.1, 0.6, 0.02)])
def test_bursts_make_the_count_vary_more(truth: Parameters) -> None:
    chains, frames = 200, 2000
    counts = [int(chain(truth, frames, seed).sum()) for seed in range(chains)]
    alone = frames * truth.loss * (1.0 - truth.loss)
    assert np.var(counts) / alone == pytest.approx(truth.inflation, rel=0.35)  # of 200: +-20 % at 95 %
    assert truth.inflation > 3.0


@pytest.mark.long
def test_the_rate_s_interval_knows_of_the_bursts() -> None:
    truth = Parameters(0.01, 0.1)
    held = []
    for seed in range(20):
        interval = losses_of(chain(truth, 5000, seed)).interval
        assert interval is not None
        held.append(interval.low <= truth.loss <= interval.high)
    assert np.mean(held) >= 0.85  # 95 % of 20: below 17 once in sixty


def test_of_too_few_losses_nothing_is_said_but_a_bound() -> None:
    outcomes = np.zeros(10_000, np.int8)
    none = losses_of(outcomes)
    assert none.model is None
    assert none.why_none == "not identifiable: 0 runs of losses"
    assert none.interval is not None
    assert none.interval.high == pytest.approx(1.0 - 0.025**1e-4)
    outcomes[100:130] = LOST
    once = losses_of(outcomes)
    assert once.model is None
    assert once.runs == (*[0] * 29, 1)
    assert once.interval is not None
    assert once.interval.high > 0.01, "one burst of 30 tells hardly more than one loss"


def test_nothing_known_is_not_measured() -> None:
    found = losses_of(np.full(100, UNKNOWN, np.int8))
    assert (found.known, found.lost, found.interval, found.why_none) == (0, 0, None, "not measured")


def test_runs_end_where_the_fate_is_unknown() -> None:
    outcomes = np.array([LOST, CAME, LOST, LOST, UNKNOWN, LOST, CAME, LOST], np.int8)
    assert losses_of(outcomes).runs == (3, 1)
    assert losses_of(np.zeros(3, np.int8)).runs == ()
