"""What may be claimed of a campaign's rows: rates against scipy's intervals, certificates, findings."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest

from servobench.hil.campaign import figures
from servobench.hil.campaign.campaign import Campaign, CounterExample, NothingCertified
from servobench.hil.campaign.figures import failure_line
from servobench.hil.campaign.statistics import ConfidenceInterval, anytime

KEPT, EXCEEDED, LEFT = "kept", "exceeded", "premises left"


def campaign(
    passed: Sequence[bool],
    points: int = 1,
    certificate: Sequence[str] = (),
    findings: Sequence[list[str]] = (),
    weights: Sequence[float] = (),
) -> Campaign:
    """Rows of so many points of a grid, one after the other; ``weights``: drawn adaptively, each counting."""
    runs = len(passed)
    plan: Any = SimpleNamespace(
        points=points,
        sweep=SimpleNamespace(
            stop=SimpleNamespace(confidence=0.9, rate_width=None),
            adaptive=SimpleNamespace(round_runs=2) if weights else None,
        ),
        own=SimpleNamespace(checks=bool(findings)),
        point_title=lambda point: "" if points == 1 else f"load {point}",
    )
    made = Campaign(Path("somewhere"), plan)
    made.__dict__["table"] = pa.table(
        {
            "run": np.arange(runs),
            "point": np.arange(runs) % points,
            "passed": list(passed),
            "certificate": list(certificate) or [""] * runs,
            "load_gain_least_rad_s_nm": 0.5 + np.arange(runs),
            "load_gain_certified_rad_s_nm": [2.0] * runs,
            "findings": list(findings) or [[] for _ in range(runs)],
            "counts": [True] * runs,
            "weight": list(weights) or [1.0] * runs,
        }
    )
    return made


@pytest.mark.parametrize(("passed", "runs"), [(20, 20), (17, 20), (0, 20), (1, 300)])
def test_the_rate_is_clopper_and_pearson_s(passed: int, runs: int) -> None:
    done = campaign([number < passed for number in range(runs)])
    for asked, confidence in ((None, 0.9), (0.99, 0.99)):
        known = binomtest(passed, runs).proportion_ci(confidence, method="exact")
        rate, failed = done.pass_rate(confidence=asked), done.failure_rate(asked)
        assert tuple(rate) == pytest.approx((passed / runs, known.low, known.high))
        assert tuple(failed) == pytest.approx((1 - passed / runs, 1 - known.high, 1 - known.low))


def test_the_rate_of_a_campaign_that_ended_when_enough_was_seen_is_the_sequence_s() -> None:
    done = campaign([number < 17 for number in range(20)])
    assert (done.sequential, done.adaptive) == (False, False)
    done.plan.sweep.stop.rate_width = 0.1
    assert done.sequential
    assert done.pass_rate() == anytime(17, 20, 0.9)
    assert done.pass_rate(confidence=0.99) == anytime(17, 20, 0.99)
    assert done.nominal.all()


def test_of_weighted_runs_failing_and_passing_add_up_to_one() -> None:
    done = campaign([False, True, True, False] * 25, weights=[0.1, 1.9, 1.8, 0.2] * 25)
    failed, passed = done.failure_rate(), done.pass_rate()
    assert failed.estimate == pytest.approx(0.3 / 4.0)
    assert 0.0 < failed.low < failed.estimate < failed.high < 1.0
    assert (passed.estimate, passed.low, passed.high) == pytest.approx(
        (1 - failed.estimate, 1 - failed.high, 1 - failed.low)
    )
    wide = done.failure_rate(0.999)
    assert wide.low < failed.low < failed.high < wide.high
    assert np.flatnonzero(done.nominal).tolist() == [0, 1]


def test_a_rate_is_held_against_each_point_one_sided() -> None:
    runs = 60
    done = campaign([number != 7 for number in range(runs)], points=2)
    known = binomtest(29, 30).proportion_ci(0.9, method="exact")  # 95 % to one side
    done.assert_pass_rate(at_least=known.low - 1e-9)
    with pytest.raises(AssertionError) as told:
        done.assert_pass_rate(at_least=known.low + 1e-9)
    text = str(told.value)
    assert text.startswith("load 1: 29 of 30 runs passed (1 did not, the first of them run 7)")
    assert "95 % confidence" in text
    assert f"least {known.low:.6g}, " in text


def test_too_few_runs_are_no_claim_though_all_passed() -> None:
    with pytest.raises(AssertionError, match=r"^10 of 10 runs passed \(0 did not\)"):
        campaign([True] * 10).assert_pass_rate(at_least=0.9)
    campaign([True] * 40).assert_pass_rate(at_least=0.9)


def test_the_first_counter_example_is_named_with_its_gain_and_command() -> None:
    done = campaign([True] * 4, certificate=[LEFT, KEPT, EXCEEDED, EXCEEDED])
    with pytest.raises(CounterExample) as told:
        done.hold_certificate()
    text = str(told.value)
    assert "run 2 " in text
    assert "at least 2.5 rad/s per N m, certified 2;" in text
    assert text.endswith("hil campaign replay somewhere --run 2")
    with pytest.raises(AssertionError, match="counter-example: run 2 "):
        done.assert_certificate()


def test_a_certificate_that_no_run_could_break_is_not_kept() -> None:
    with pytest.raises(NothingCertified, match="1 without a certificate, 2 premises left"):
        campaign([True] * 3, certificate=[LEFT, "", LEFT]).hold_certificate()
    with pytest.raises(AssertionError, match="2 premises left"):
        campaign([True] * 2, certificate=[LEFT, LEFT]).assert_certificate()
    campaign([True] * 3, certificate=[LEFT, KEPT, LEFT]).assert_certificate()


def test_what_a_check_found_is_told_by_run_with_the_commands() -> None:
    done = campaign([True] * 3, findings=[[], ["rang", "was late"], []])
    with pytest.raises(AssertionError) as told:
        done.assert_nothing_found()
    assert str(told.value).splitlines() == [
        "run 1: rang",
        "run 1: was late",
        "hil campaign replay somewhere --run 1",
    ]
    campaign([True] * 2, findings=[[], []]).assert_nothing_found()
    assert campaign([True]).found == {}


@pytest.mark.parametrize(
    ("rate", "plain_runs"),
    [
        # deviation: a tenth over the 95th percentile of a normal, 1.6449; 0.2 x 0.8 / 0.060796^2
        (ConfidenceInterval(0.2, 0.1, 0.3), 43),
        (ConfidenceInterval(0.2, 0.19, 0.21), 4329),
        (ConfidenceInterval(0.2, 0.2, 0.2), None),
        (ConfidenceInterval(0.0, 0.0, 0.1), None),
    ],
)
def test_as_many_plain_runs_would_know_the_failure_probability_as_well(
    rate: ConfidenceInterval, plain_runs: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = campaign([True] * 4, weights=[1.0] * 4)
    monkeypatch.setattr(Campaign, "failure_rate", lambda _done: rate)
    assert figures._failure(done) == {
        "rate": rate.estimate,
        "low": rate.low,
        "high": rate.high,
        "counting": 4,
        "plain_runs": plain_runs,
    }


def test_a_failure_probability_in_words() -> None:
    rates = {"rate": 1.25e-4, "low": 1e-5, "high": 1e-3, "counting": 800, "plain_runs": 31000}
    text = failure_line(rates)
    assert text.startswith("failure probability 0.000125, 1e-05 to 0.001, by 800 weighted runs")
    assert text.endswith("plain draws would take 31000 for it")
    unknown = failure_line(rates | {"rate": None, "plain_runs": None})
    assert unknown.startswith("failure probability not known, 1e-05 to 0.001")
    assert "plain draws" not in unknown
