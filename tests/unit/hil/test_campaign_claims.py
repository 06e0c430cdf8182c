"""What may be claimed of a campaign's rows: rates against scipy's intervals, certificates, findings."""

import math
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from servobench.hil.campaign.campaign import Campaign, CounterExample, NothingCertified
from servobench.hil.campaign.figures import failure_line, figures_of
from servobench.hil.campaign.statistics import anytime
from tests.unit.hil.made_campaigns import INERTIA, campaign_of, plan_of

KEPT, EXCEEDED, LEFT = "kept", "exceeded", "premises left"
Make = Callable[..., Campaign]


@pytest.fixture
def campaign(tmp_path: Path) -> Make:
    """Make a campaign of runs that passed or not, over so many ``points``, one after the other.

    ``weights``: drawn adaptively, each counting.
    """
    (tmp_path / "own.py").write_text("def check(seed, run):\n    return []\n")
    made = count()

    def make(
        passed: Sequence[bool],
        points: int = 1,
        certificate: Sequence[str] = (),
        findings: Sequence[list[str]] = (),
        weights: Sequence[float] = (),
        **stop: float,
    ) -> Campaign:
        tables: dict[str, Any] = {"stop": {"confidence": 0.9, **stop}}
        if points > 1:
            tables["vary"] = [
                {"key": "faults.loss.0.probability", "values": [float(point) for point in range(points)]}
            ]
        if weights:
            tables |= {"draw": [INERTIA], "adaptive": {"guide": "speed_error_peak_percent", "round_runs": 20}}
        if findings:
            tables["own"] = {"check": "own.py:check"}
        rows: list[dict[str, Any]] = [
            {
                "passed": each,
                "certificate": certificate[run] if certificate else "",
                "load_gain_least_rad_s_nm": 0.5 + run,
                "load_gain_certified_rad_s_nm": 2.0,
            }
            for run, each in enumerate(passed)
        ]
        for row, texts in zip(rows, findings, strict=False):
            row["findings"] = texts
        for row, weight in zip(rows, weights, strict=False):
            row |= {"weight": weight, "counts": True}
        plan = plan_of(seeds=math.ceil(len(passed) / points), source=tmp_path / "sweep.toml", **tables)
        return campaign_of(tmp_path / f"campaign{next(made)}", plan, rows)

    return make


@pytest.mark.parametrize(("passed", "runs"), [(20, 20), (17, 20), (0, 20), (1, 300)])
def test_the_rate_is_clopper_and_pearson_s(campaign: Make, passed: int, runs: int) -> None:
    done = campaign([number < passed for number in range(runs)])
    for asked, confidence in ((None, 0.9), (0.99, 0.99)):
        known = binomtest(passed, runs).proportion_ci(confidence, method="exact")
        rate, failed = done.pass_rate(confidence=asked), done.failure_rate(asked)
        assert tuple(rate) == pytest.approx((passed / runs, known.low, known.high))
        assert tuple(failed) == pytest.approx((1 - passed / runs, 1 - known.high, 1 - known.low))


def test_the_rate_of_a_campaign_that_ended_when_enough_was_seen_is_the_sequence_s(campaign: Make) -> None:
    assert not campaign([True]).sequential
    done = campaign([number < 17 for number in range(20)], rate_width=0.1)
    assert (done.sequential, done.adaptive) == (True, False)
    assert done.pass_rate() == anytime(17, 20, 0.9)
    assert done.pass_rate(confidence=0.99) == anytime(17, 20, 0.99)
    assert done.nominal.all()


def test_of_weighted_runs_failing_and_passing_add_up_to_one(campaign: Make) -> None:
    done = campaign([False, True, True, False] * 25, weights=[0.1, 1.9, 1.8, 0.2] * 25)
    failed, passed = done.failure_rate(), done.pass_rate()
    assert failed.estimate == pytest.approx(0.3 / 4.0)
    assert 0.0 < failed.low < failed.estimate < failed.high < 1.0
    assert (passed.estimate, passed.low, passed.high) == pytest.approx(
        (1 - failed.estimate, 1 - failed.high, 1 - failed.low)
    )
    wide = done.failure_rate(0.999)
    assert wide.low < failed.low < failed.high < wide.high
    assert np.flatnonzero(done.nominal).tolist() == list(range(20))


def test_a_rate_is_held_against_each_point_one_sided(campaign: Make) -> None:
    runs = 60
    done = campaign([number != 7 for number in range(runs)], points=2)
    known = binomtest(29, 30).proportion_ci(0.9, method="exact")  # 95 % to one side
    done.assert_pass_rate(at_least=known.low - 1e-9)
    with pytest.raises(AssertionError) as told:
        done.assert_pass_rate(at_least=known.low + 1e-9)
    text = str(told.value)
    assert text.startswith(
        "faults.loss.0.probability = 1: 29 of 30 runs passed (1 did not, the first of them run 7)"
    )
    assert "95 % confidence" in text
    assert f"least {known.low:.6g}, " in text


def test_too_few_runs_are_no_claim_though_all_passed(campaign: Make) -> None:
    with pytest.raises(AssertionError, match=r"^10 of 10 runs passed \(0 did not\)"):
        campaign([True] * 10).assert_pass_rate(at_least=0.9)
    campaign([True] * 40).assert_pass_rate(at_least=0.9)


def test_the_first_counter_example_is_named_with_its_gain_and_command(campaign: Make) -> None:
    done = campaign([True] * 4, certificate=[LEFT, KEPT, EXCEEDED, EXCEEDED])
    with pytest.raises(CounterExample) as told:
        done.hold_certificate()
    text = str(told.value)
    assert "run 2 " in text
    assert "at least 2.5 rad/s per N m, certified 2;" in text
    assert text.endswith(f"hil campaign replay {done.folder} --run 2")
    with pytest.raises(AssertionError, match="counter-example: run 2 "):
        done.assert_certificate()


def test_a_certificate_that_no_run_could_break_is_not_kept(campaign: Make) -> None:
    with pytest.raises(NothingCertified, match="1 without a certificate, 2 premises left"):
        campaign([True] * 3, certificate=[LEFT, "", LEFT]).hold_certificate()
    with pytest.raises(AssertionError, match="2 premises left"):
        campaign([True] * 2, certificate=[LEFT, LEFT]).assert_certificate()
    campaign([True] * 3, certificate=[LEFT, KEPT, LEFT]).assert_certificate()


def test_what_a_check_found_is_told_by_run_with_the_commands(campaign: Make) -> None:
    done = campaign([True] * 3, findings=[[], ["rang", "was late"], []])
    with pytest.raises(AssertionError) as told:
        done.assert_nothing_found()
    assert str(told.value).splitlines() == [
        "run 1: rang",
        "run 1: was late",
        f"hil campaign replay {done.folder} --run 1",
    ]
    campaign([True] * 2, findings=[[], []]).assert_nothing_found()
    assert campaign([True]).found == {}


def test_as_many_plain_runs_would_know_the_failure_probability_as_well(campaign: Make) -> None:
    done = campaign([number % 5 > 0 for number in range(100)], weights=[0.5, 1.2, 1.1, 1.1, 1.1] * 20)
    told, rate = figures_of(done)["failure"], done.failure_rate()
    assert (told["rate"], told["low"], told["high"], told["counting"]) == (*rate, 100)
    deviation = (rate.high - rate.low) / (2.0 * 1.6448536)  # the 95th percentile of a normal
    assert told["plain_runs"] == round(0.1 * 0.9 / deviation**2)
    none_failed = figures_of(campaign([True] * 40, weights=[1.0] * 40))["failure"]
    assert (none_failed["rate"], none_failed["plain_runs"]) == (0.0, None)


def test_a_failure_probability_in_words() -> None:
    rates = {"rate": 1.25e-4, "low": 1e-5, "high": 1e-3, "counting": 800, "plain_runs": 31000}
    text = failure_line(rates)
    assert text.startswith("failure probability 0.000125, 1e-05 to 0.001, by 800 weighted runs")
    assert text.endswith("plain draws would take 31000 for it")
    unknown = failure_line(rates | {"rate": None, "plain_runs": None})
    assert unknown.startswith("failure probability not known, 1e-05 to 0.001")
    assert "plain draws" not in unknown
