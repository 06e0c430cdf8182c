"""``hil analyse speed``: which question its options are, and what comes of the answers."""

import json

import pytest
from typer.testing import Result

from servobench.design.errors import DesignError
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.speed.monte_carlo import Chance
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.studies.speed import analysis
from tests.unit.hil.asked_studies import FILE, MOTOR, RATED, SIMULATED, Studies, hil, refusal


@pytest.fixture
def analyses(monkeypatch: pytest.MonkeyPatch) -> Studies:
    studies = Studies()
    for name in ("continuous_figures", "figures_as_printed", "sampled_figures", "chance_figures"):
        monkeypatch.setattr(analysis, name, studies.answering(name))
    return studies


def analyse(*arguments: str) -> Result:
    return hil("analyse", "speed", FILE, *arguments)


def test_a_loop_with_a_constant_delay_is_asked_for_in_si(analyses: Studies) -> None:
    told = analyse("--gain", "0.5,-0.0212", "--delay-ms", "64", "--json")
    assert json.loads(told.stdout) == {"current_bandwidth_from": SIMULATED, "continuous_figures": "told"}
    assert set(analyses.asked) == {"continuous_figures"}
    (request,) = analyses.asked["continuous_figures"]
    assert request.K.tolist() == [0.5, -0.0212]
    assert (request.motor, request.delay_s, request.order) == (MOTOR, 0.064, None)
    assert (request.load_nm, request.speed_rad_s, request.current_bandwidth_hz) == (*RATED, 800.0)
    analyse(
        "--gain", "1,2,3", "--delay-ms", "0", "--order", "0", "--load-nm", "0.6", "--speed-rpm", "1500",
        "--current-bandwidth-hz", "250",
    )  # fmt: skip
    (request,) = analyses.asked["continuous_figures"]
    assert request.K.tolist() == [1.0, 2.0, 3.0]
    assert (request.delay_s, request.order) == (0.0, 0)
    assert (request.load_nm, request.current_bandwidth_hz) == (0.6, 250.0)
    assert request.speed_rad_s == 1500.0 * RAD_S_PER_RPM


def test_what_is_asked_for_beside_stands_beside(analyses: Studies) -> None:
    told = analyse(
        "--gain", "0,1", "--as-printed", "--period-ms", "10", "--loss-max", "5", "--tau-max-ms", "4",
        "--monte-carlo", "200", "--seed", "3", "--loss-probability", "0.25", "--uncertainty-percent", "20",
        "--duration-s", "2", "--load-nm", "0.5", "--json",
    )  # fmt: skip
    assert json.loads(told.stdout) == {
        "current_bandwidth_from": SIMULATED,
        "continuous_figures": "told",
        "as_printed": {"figures_as_printed": "told"},
        "sampled_figures": "told",
        "monte_carlo": {"chance_figures": "told"},
    }
    request, network, chance = analyses.asked["chance_figures"]
    assert network == SampledNetwork(Strategy.ARRIVAL, 0.01, 5, 0.004, 0.0)
    assert chance == Chance(200, 3, 2.0, 0.25, 0.5, 0.2)
    assert request.delay_s == pytest.approx(0.064), "[Ling2012] (2.13)"
    assert analyses.asked["sampled_figures"] == (request, network)
    assert analyses.asked["figures_as_printed"] == analyses.asked["continuous_figures"] == (request,)
    plain = analyse("--gain", "0,1", "--period-ms", "10", "--delay-ms", "7", "--json")
    assert set(json.loads(plain.stdout)) == {
        "current_bandwidth_from", "continuous_figures", "sampled_figures",
    }  # fmt: skip
    request, network = analyses.asked["sampled_figures"]
    assert (request.delay_s, network) == (0.007, SampledNetwork(Strategy.ARRIVAL, 0.01, 0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("options", "network"),
    [
        # (losses + 1) periods and the delay, where nothing is agreed upon
        (("--strategy", "stamp"), SampledNetwork(Strategy.STAMP, 0.01, 0, 0.0, 0.01)),
        (
            ("--strategy", "history", "--loss-max", "2", "--tau-max-ms", "4"),
            SampledNetwork(Strategy.HISTORY, 0.01, 2, 0.004, 0.034),
        ),
        (("--strategy", "stamp", "--delay-ms", "12"), SampledNetwork(Strategy.STAMP, 0.01, 0, 0.0, 0.012)),
    ],
)
def test_strategies_that_wait_have_an_agreed_delay(
    analyses: Studies, options: tuple[str, ...], network: SampledNetwork
) -> None:
    analyse("--gain", "0,1", "--period-ms", "10", *options)
    asked = analyses.asked["sampled_figures"][1]
    assert asked.agreed_delay_s == pytest.approx(network.agreed_delay_s)
    assert (asked.strategy, asked.period_s, asked.losses_max, asked.delay_max_s) == (
        network.strategy, network.period_s, network.losses_max, network.delay_max_s,
    )  # fmt: skip


GAINS = "K1,K2 in A/A and A s/rad, or K1,K2,K3 with the integral gain in A/rad, all finite"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        *((("--gain", text, "--delay-ms", "1"), f"--gain: found '{text}', expected {GAINS}")
          for text in ("1", "1,2,3,4", "1;2", "0,nan", "inf,1", "")),
        (
            ("--gain", "0,1"),
            "--delay-ms: missing, expected the constant delay, ms; or give --period-ms and the network",
        ),
        *((("--gain", "0,1", "--delay-ms", "1", option, value),
           f"{option}: found '{value}', expected --period-ms with it, the sampling period")
          for option, value in (("--strategy", "arrival"), ("--loss-max", "0"), ("--tau-max-ms", "0.0"))),
        (
            ("--gain", "0,1", "--delay-ms", "1", "--monte-carlo", "5"),
            "--monte-carlo: found 5, expected a sampled loop: --period-ms and the network",
        ),
        (
            ("--gain", "0,1", "--period-ms", "1", "--delay-ms", "1", "--strategy", "stamp",
             "--tau-max-ms", "3"),
            "--strategy: found 'an agreed delay of 1 ms for stamp', expected at least 3 ms, by when the "
            "sample certainly is there",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_analysed_is_refused_by_its_option(
    analyses: Studies, options: tuple[str, ...], said: str
) -> None:
    assert refusal(analyse(*options)) == said
    assert analyses.asked == {}


def test_a_loop_that_cannot_be_analysed_is_bad_input(analyses: Studies) -> None:
    analyses.fails = DesignError("no loop at all")
    said = f"{FILE}: found 'no loop at all', expected a loop that can be analysed"
    assert refusal(analyse("--gain", "0,1", "--delay-ms", "1")) == said
