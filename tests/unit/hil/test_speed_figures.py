"""What is told of a speed loop, from figures that are made up; the solvers are held elsewhere."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from servobench.design.delay.certificate import CertifiedGain
from servobench.design.delay.lmi import SOLVED, SOLVER
from servobench.design.errors import NoSolution
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.speed.monte_carlo import Chance
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.studies.speed import analysis
from servobench.hil.studies.speed.analysis import (
    LoopRequest,
    chance_figures,
    continuous_figures,
    figures_as_printed,
    network_figures,
    sampled_figures,
    sequence_figures,
)
from tests.unit.hil.made_analyses import ARRIVAL, STAMP, made_analysis, unproved

MOTOR = LING2012.parameters
SHARE = 100.0 * 0.5 / 40.0
"""Percent of 40 rad/s for 1 rad/s per N m under 0.5 N m."""


def request(order: int | None = None, gains: int = 2, bandwidth_hz: float | None = 150.0) -> LoopRequest:
    return LoopRequest(MOTOR, np.array([0.0, -0.02, -0.5][:gains]), 0.064, order, 0.5, 40.0, bandwidth_hz)


class Solvers:
    """In place of those of the design: by order what is certified; where there is nothing, none is."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.gains: dict[int | None, float] = {}
        self.delays: dict[int, float] = {}
        self.tried: list[int | None] = []
        self.exact, self.delay_max_s, self.peak = 100.0, 0.17, 80.0
        for name, put in {
            "certified_gain": lambda _model, _loop, order: self.gain(order),
            "certified_gain_auto": lambda _model, _loop: self.gain(None),
            "certified_delay_s": self.delay,
            "hinf_peak": lambda _loop: SimpleNamespace(gain=self.exact, frequency_rad_s=12.0),
            "hinf_norm": lambda _loop: self.exact,
            "largest_stable_delay_s": lambda _loop: self.delay_max_s,
            "step_peak": lambda _loop: self.peak,
        }.items():
            monkeypatch.setattr(analysis, name, put)

    def gain(self, order: int | None) -> CertifiedGain:
        self.tried.append(order)
        if order not in self.gains:
            raise NoSolution(f"order {order}", "it fails")
        return CertifiedGain(self.gains[order], 9 if order is None else order, 1e-4)

    def delay(self, _model: Any, _loop: Any, order: int) -> float:
        return self.delays.get(order, 0.0)


@pytest.fixture
def solvers(monkeypatch: pytest.MonkeyPatch) -> Solvers:
    return Solvers(monkeypatch)


def test_the_model_has_an_integral_with_the_third_gain() -> None:
    assert request(gains=2).model.A.shape == (2, 2)
    assert request(gains=3).model.A.shape == (3, 3)
    assert request().model.A[0, 0] == pytest.approx(-2.0 * math.pi * 150.0)
    winding = request(bandwidth_hz=None).model.A[0, 0]
    assert winding == pytest.approx(-MOTOR.resistance_ohm / MOTOR.inductance_q_h)


def test_the_figures_of_the_constant_delay_are_whole(solvers: Solvers) -> None:
    solvers.gains, solvers.delays = {None: 100.05}, {0: 0.1, 1: 0.16, 2: 0.1699}
    friction, inertia = MOTOR.viscous_friction_nm_s, MOTOR.inertia_kg_m2
    floor = (1.0 - math.exp(-friction * 0.064 / inertia)) / friction
    assert continuous_figures(request()) == {
        "stable": True,
        "gain": [0.0, -0.02],
        "current_bandwidth_hz": 150.0,
        "delay_s": 0.064,
        "gamma_exact": 100.0,
        "peak_frequency_rad_s": 12.0,
        "gamma_certified": 100.05,
        "order": 9,
        "order_limit_reached": False,
        "certificate": {"solver": SOLVER, "status": f"{SOLVED} at order 9", "min_margin": 1e-4},
        "delay_max_exact_s": 0.17,
        "delay_max_certified_s": 0.1699,
        "delay_order": 2,
        "step_load_nm": 1.0,
        "step_peak_rad_s": 80.0,
        "step_peak_floor_rad_s": pytest.approx(floor),
        "percent": {
            "load_nm": 0.5,
            "speed_rad_s": 40.0,
            "gamma_exact": 100.0 * SHARE,
            "gamma_certified": 100.05 * SHARE,
            "step_peak_rad_s": 40.0,
            "step_peak": 80.0 * SHARE,
            "step_peak_floor": pytest.approx(floor * SHARE),
        },
    }


def test_what_is_infinite_is_none(solvers: Solvers) -> None:
    solvers.exact, solvers.delay_max_s, solvers.peak = math.inf, math.inf, math.inf
    found = continuous_figures(request())
    names = ("gamma_exact", "peak_frequency_rad_s", "gamma_certified", "order", "step_peak_rad_s")
    assert [found[name] for name in names] == [None] * 5
    assert (found["stable"], found["order_limit_reached"], found["delay_max_exact_s"]) == (False, False, None)
    assert found["certificate"]["min_margin"] is None
    shares = ("gamma_exact", "gamma_certified", "step_peak_rad_s", "step_peak")
    assert [found["percent"][name] for name in shares] == [None] * 4
    assert found["delay_max_certified_s"] == 0.0


@pytest.mark.parametrize(
    ("certified", "order", "reached"),
    [(100.1, None, False), (100.11, None, True), (100.11, 3, False), (None, None, True)],
)
def test_a_certificate_that_is_not_close_is_told(
    solvers: Solvers, certified: float | None, order: int | None, reached: bool
) -> None:
    """Within a thousandth of 100; not where an order was asked for."""
    solvers.gains = {} if certified is None else {order: certified}
    assert continuous_figures(request(order))["order_limit_reached"] is reached


@pytest.mark.parametrize(
    ("known", "tried", "order", "status"),
    [
        ({2: 110.0}, [2], 2, f"{SOLVED} at order 2"),
        ({1: 110.0}, [2, 1], 1, f"{NoSolution('order 2', 'it fails')}; {SOLVED} at order 1"),
        ({}, [2, 1, 0], None, "; ".join(str(NoSolution(f"order {n}", "it fails")) for n in (2, 1, 0))),
    ],
)
def test_a_lower_order_stands_in_for_one_that_fails(
    solvers: Solvers, known: dict[int | None, float], tried: list[int], order: int | None, status: str
) -> None:
    solvers.gains = known
    found = continuous_figures(request(2))
    assert solvers.tried == tried
    assert (found["order"], found["certificate"]["status"]) == (order, status)


@pytest.mark.parametrize(
    ("delays", "best"),
    [
        ({}, (0.0, 0)),
        ({0: 0.1, 1: 0.1, 2: 0.09}, (0.1, 0)),
        ({0: 0.17 / 1.001 * (1 + 1e-12), 1: 0.17}, (0.17 / 1.001 * (1 + 1e-12), 0)),
        ({0: 0.1698, 1: 0.16985}, (0.1698, 0)),
        ({0: 0.1690, 1: 0.1695}, (0.1695, 1)),
        ({5: 0.12, 6: 0.13, 7: 0.17}, (0.13, 6)),
    ],
)
def test_the_certified_delay_is_of_the_lowest_order_that_is_close(
    solvers: Solvers, delays: dict[int, float], best: tuple[float, int]
) -> None:
    solvers.delays = delays
    found = continuous_figures(request())
    assert (found["delay_max_certified_s"], found["delay_order"]) == (best[0], best[1])


def test_a_delay_of_an_order_is_that_order_s(solvers: Solvers) -> None:
    solvers.delays = {3: 0.01, 4: 0.1}
    found = continuous_figures(request(3))
    assert (found["delay_max_certified_s"], found["delay_order"]) == (0.01, 3)


def test_the_theorems_as_printed_stand_beside_order_0(
    solvers: Solvers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(analysis, "theorem_3_1", lambda _loop, _scale: True)
    monkeypatch.setattr(analysis, "theorem_3_3", lambda _loop, _scale, about: 2.0 * about)
    solvers.gains = {0: 130.0}
    printed = {"theorem_3_1_stable": True, "theorem_3_3_gamma": 200.0, "order_0_gamma": 130.0}
    assert figures_as_printed(request()) == printed
    solvers.gains = {}
    solvers.exact = math.inf
    unstable = {"theorem_3_1_stable": True, "theorem_3_3_gamma": None, "order_0_gamma": None}
    assert figures_as_printed(request()) == unstable

    def fails(*_: Any) -> float:
        raise NoSolution("theorem 3.3", "it fails")

    solvers.exact = 100.0
    monkeypatch.setattr(analysis, "theorem_3_3", fails)
    assert figures_as_printed(request()) == unstable


def test_a_network_is_told_with_the_delay_that_was_agreed() -> None:
    assert network_figures(STAMP) == {
        "strategy": "stamp",
        "period_s": 0.01,
        "loss_max": 2,
        "tau_max_s": 0.004,
        "agreed_delay_s": 0.01,
    }
    assert network_figures(ARRIVAL)["agreed_delay_s"] is None


def test_certified_stands_beside_found() -> None:
    assert sequence_figures(made_analysis(), 2.0) == {
        "certified": True,
        "refuted": False,
        "sequences": {
            "step_peak_rad_s": {"certified": 50.0, "found": 40.0, "gap_percent": 25.0},
            "step_peak_percent": {"certified": 100.0, "found": 80.0, "gap_percent": 25.0},
            "gain": {"certified": 125.0, "found": 100.0, "gap_percent": 25.0},
            "error_percent": {"certified": 250.0, "found": 200.0, "gap_percent": 25.0},
            "decay_per_s": {"certified": 3.0, "found": 4.0, "gap_percent": 25.0},
            "gain_pattern": [{"delay_s": 0.01, "lost_after": 1}],
            "decay_pattern": [{"delay_s": 0.01, "lost_after": 2}],
        },
        "sequence_certificate": {"solver": SOLVER, "status": SOLVED, "min_margin": 2e-4},
    }


def test_what_is_refuted_has_no_certificate() -> None:
    found = sequence_figures(unproved("it is unstable"), 2.0)
    assert (found["certified"], found["refuted"]) == (False, True)
    nothing = {"certified": None, "found": None, "gap_percent": None}
    for name in ("step_peak_rad_s", "step_peak_percent", "gain", "error_percent"):
        assert found["sequences"][name] == nothing
    assert found["sequences"]["decay_per_s"] == {"certified": None, "found": -1.0, "gap_percent": None}
    certificate = {"solver": SOLVER, "status": "it is unstable", "min_margin": None}
    assert found["sequence_certificate"] == certificate


def test_half_a_proof_is_none() -> None:
    found = sequence_figures(made_analysis(gain_proof=None, without_certificate="no gain"), 2.0)
    assert (found["certified"], found["sequence_certificate"]["min_margin"]) == (False, None)
    assert found["sequences"]["decay_per_s"]["certified"] == 3.0


def test_the_sampled_loop_is_told_by_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(analysis, "analyse_sampled", lambda _model, _gain, network: network)
    monkeypatch.setattr(analysis, "with_peak", lambda network: made_analysis(network, gains=[90.0, math.inf]))
    found = sampled_figures(request(), STAMP)
    assert found["by_losses"] == [
        {"lost": 0, "decay_per_s": 9.0, "gamma": 90.0},
        {"lost": 1, "decay_per_s": 6.0, "gamma": None},
    ]
    assert found["age_max_s"] == pytest.approx(0.01 + 3 * 0.01)
    assert found["loss_max"] == 2
    assert found["sequences"]["error_percent"]["found"] == pytest.approx(100.0 * SHARE)


def test_chance_is_told_with_its_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    peaks = np.append(np.arange(1.0, 200.0), math.inf)
    asked: list[Any] = []

    def run_many(*given: Any) -> np.ndarray:
        asked.extend(given)
        return peaks

    monkeypatch.setattr(analysis, "run_many", run_many)
    chance = Chance(200, 7, 1.5, 0.25, 0.8)
    found = chance_figures(request(), STAMP, chance)
    assert (asked[0], asked[2:]) == (MOTOR, [STAMP, chance, 150.0])
    limits = [beta.ppf(0.025, 1, 200), beta.ppf(0.975, 2, 199)]
    assert found["diverged"] == pytest.approx({"value": 1 / 200, "low": limits[0], "high": limits[1]})
    assert found["peak_rad_s"].keys() == {"p50", "p90", "p99"}
    median = found["peak_rad_s"]["p50"]
    half = 1.96 * math.sqrt(200 / 4)
    places = (math.floor(0.5 * 199), math.floor(100 - half), math.ceil(100 + half))
    assert median == dict(zip(("value", "low", "high"), (peaks[place] for place in places), strict=True))
    assert found["peak_percent"]["p50"] == pytest.approx(
        {name: 100.0 * value / 40.0 for name, value in median.items()}
    )
    assert found["peak_rad_s"]["p99"]["high"] is None
    assert found["largest_peak_rad_s"] is None
    told = ("runs", "seed", "duration_s", "loss_probability", "load_nm")
    assert [found[name] for name in told] == [200, 7, 1.5, 0.25, 0.8]


def test_a_network_of_history_is_named_so() -> None:
    network = SampledNetwork(Strategy.HISTORY, 0.002, 1, 0.001, 0.004)
    assert network_figures(network)["strategy"] == "history"
    assert network_figures(network)["agreed_delay_s"] == 0.004
