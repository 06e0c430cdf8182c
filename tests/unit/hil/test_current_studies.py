"""What is told of a designed current controller, put together from figures that are made up."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servobench.design.current.current_loop import Decoupling
from servobench.design.hinf.reduction import Method
from servobench.design.statespace import StateSpace
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.studies.current import design
from servobench.hil.studies.current import design as studies
from servobench.hil.studies.current.design import CurrentRequest, OtherAxis, robust_figures, sampled_design
from tests.unit.hil.made_analyses import MARGINS

MOTOR = LING2012.parameters
OWN: Any = SimpleNamespace(name="own")
OTHER = OtherAxis(SimpleNamespace(name="other"), 900.0)  # type: ignore[arg-type]
LOOP = SimpleNamespace(margins=replace(MARGINS, gain_margin_db=math.inf), spectral_radius=0.75)
LOOP_FIGURES = {
    "phase_margin_deg": 45.0,
    "gain_margin_db": None,
    "modulus_margin": 0.6,
    "spectral_radius": 0.75,
}
DESIGN: Any = SimpleNamespace(plant="G", weights="W", controller=OWN, margins=MARGINS, closed_loop_norm=0.9)


def request(**changes: Any) -> CurrentRequest:
    asked: dict[str, Any] = {
        "motor": MOTOR,
        "axis": "q",
        "weights": None,
        "gamma": None,
        "gamma_factor": None,
        "structure": "full",
        "order": None,
        "method": Method.PAPER,
        "rate_hz": 16_000.0,
        "delay_samples": 1,
        "discrete": False,
        "modulus_margin": None,
        "other": None,
        "speed_max_rad_s": None,
        "decoupling_factor": 1.0,
        "advance_periods": None,
    }
    return CurrentRequest(**(asked | changes))


class Solvers:
    """In place of those of the design: what they were asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: dict[str, list[Any]] = {}
        self.loop: Any = LOOP
        self.radii: list[Any] = []
        self.synthesis = SimpleNamespace(controller=OWN, gamma=0.8, gamma_min=0.7, norm=0.79)
        answers: dict[str, Any] = {
            "tustin": lambda controller, *_: controller,
            "sampled_figures": lambda *_: self.loop,
            "lowest_rate_hz": lambda *_: 5_000.0,
            "lowest_coupled_rate_hz": lambda *_: 6_000.0,
            "discrete_design": lambda *_: self.synthesis,
            "gamma_min_over_rates": lambda _plant, _weights, rates, _delay: [rate / 1e4 for rate in rates],
            "discrete_plant": lambda *_: "P",
            "verified_norm": lambda *_: math.inf,
            "to_bilinear": lambda controller: controller,
            "spectral_radius": self._radius,
        }
        for name, answer in answers.items():
            monkeypatch.setattr(design, name, self._noting(name, answer))

    def _noting(self, name: str, answer: Any) -> Any:
        def asked(*given: Any) -> Any:
            self.asked.setdefault(name, []).append(given)
            return answer(*given)

        return asked

    def _radius(self, _motor: Any, _d: Any, _q: Any, speeds: Any, decoupling: Any, _delay: int) -> Any:
        self.radii.append(decoupling)
        return speeds * 0.0 + len(self.radii)


@pytest.fixture
def solvers(monkeypatch: pytest.MonkeyPatch) -> Solvers:
    return Solvers(monkeypatch)


def test_a_pair_of_controllers_is_that_of_d_and_q() -> None:
    assert OTHER.pair("d", OWN) == (OWN, OTHER.controller)
    assert OTHER.pair("q", OWN) == (OTHER.controller, OWN)


def test_a_sampled_controller_is_told_whole(solvers: Solvers) -> None:
    controller, found = sampled_design(request(), 1.0, DESIGN, OTHER, 200.0)
    assert controller is OWN
    coupled = found.pop("coupled")
    assert found == {
        "rate_hz": 16_000.0,
        "delay_samples": 1,
        "method": "tustin",
        **LOOP_FIGURES,
        "lowest_rate": {
            "modulus_margin": pytest.approx(0.9 * 0.6),
            "margin_rate_hz": 5_000.0,
            "coupled_rate_hz": 6_000.0,
            "rate_hz": 6_000.0,
        },
    }
    assert coupled == {
        "speed_rad_s": pytest.approx([20.0 * step for step in range(11)]),
        "decoupled": [1.0] * 11,
        "not_decoupled": [2.0] * 11,
        "without_advance": [3.0] * 11,
        "decoupling_factor": 1.0,
        "advance_periods": 1.5,
    }
    d, q = MOTOR.inductance_d_h, MOTOR.inductance_q_h
    assert solvers.radii == [Decoupling(d, q, 1.5), None, Decoupling(d, q, 0.0)]
    assert solvers.asked["tustin"] == [(OTHER.controller, 16_000.0, 900.0), (OWN, 16_000.0, 30.0)]
    assert solvers.asked["sampled_figures"] == [("G", OWN, 1)]
    assert solvers.asked["lowest_rate_hz"] == [("G", OWN, 30.0, pytest.approx(0.54), 1)]
    assert solvers.asked["lowest_coupled_rate_hz"] == [
        (MOTOR, OTHER.controller, OWN, (900.0, 30.0), 200.0, 1)
    ]


def test_the_crossovers_of_d_and_q_stand_in_their_order(solvers: Solvers) -> None:
    sampled_design(request(axis="d", modulus_margin=0.4), 1.0, DESIGN, OTHER, 200.0)
    assert solvers.asked["lowest_rate_hz"][0][3] == 0.4
    assert solvers.asked["lowest_coupled_rate_hz"][0][1:4] == (OWN, OTHER.controller, (30.0, 900.0))


@pytest.mark.parametrize(("coupled", "lowest"), [(None, None), (4_000.0, 5_000.0), (5_001.0, 5_001.0)])
def test_the_lowest_rate_holds_margin_and_both_axes(
    solvers: Solvers, monkeypatch: pytest.MonkeyPatch, coupled: float | None, lowest: float | None
) -> None:
    monkeypatch.setattr(design, "lowest_coupled_rate_hz", lambda *_: coupled)
    _, found = sampled_design(request(), 1.0, DESIGN, OTHER, 200.0)
    assert (found["lowest_rate"]["coupled_rate_hz"], found["lowest_rate"]["rate_hz"]) == (coupled, lowest)
    assert solvers.radii != []


def test_a_decoupling_that_was_asked_for_stands_beside_the_right_one(solvers: Solvers) -> None:
    asked = request(decoupling_factor=0.8, advance_periods=1.0)
    _, found = sampled_design(asked, 1.0, DESIGN, OTHER, 200.0)
    assert found["coupled"]["as_asked"] == [4.0] * 11
    assert (found["coupled"]["decoupling_factor"], found["coupled"]["advance_periods"]) == (0.8, 1.0)
    d, q = MOTOR.inductance_d_h * 0.8, MOTOR.inductance_q_h * 0.8
    assert solvers.radii[3] == Decoupling(d, q, 1.0)


@pytest.mark.parametrize(("radius", "stable"), [(0.99999, True), (1.0, False)])
def test_a_rate_at_which_the_loop_is_unstable_is_refused(
    solvers: Solvers, radius: float, stable: bool
) -> None:
    solvers.loop = SimpleNamespace(margins=MARGINS, spectral_radius=radius)
    if stable:
        assert sampled_design(request(), 1.0, DESIGN, OTHER, 200.0)[1]["spectral_radius"] == radius
        return
    with pytest.raises(BadInput) as caught:
        sampled_design(request(), 1.0, DESIGN, OTHER, 200.0)
    assert str(caught.value) == (
        "--sample-rate-hz: found 16000.0, expected a rate at which the loop is stable; its spectral radius "
        "is 1.0000; sample faster, shorten the delay, lower the crossing of w1, or design with --discrete"
    )


def test_a_rate_that_is_too_low_for_the_rule_is_refused(
    solvers: Solvers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_low(*_: Any) -> StateSpace:
        raise ValueError("more than twice the crossover")

    monkeypatch.setattr(design, "tustin", too_low)
    with pytest.raises(BadInput) as caught:
        sampled_design(request(), 1.0, DESIGN, OTHER, 200.0)
    assert str(caught.value) == "--sample-rate-hz: found 16000.0, expected more than twice the crossover"
    assert solvers.asked == {}


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [({}, (1.25, 1.05)), ({"gamma": 0.9}, (0.9, 1.05)), ({"gamma_factor": 1.2}, (0.0, 1.2)),
     ({"gamma": 0.8, "gamma_factor": 1.2}, (0.8, 1.2))],
)  # fmt: skip
def test_a_controller_for_the_sampled_plant_is_told_beside_the_continuous_one(
    solvers: Solvers, changes: dict[str, float], wanted: tuple[float, float]
) -> None:
    controller, found = sampled_design(request(discrete=True, **changes), 1.25, DESIGN, OTHER, 200.0)
    assert controller is OWN
    assert solvers.asked["discrete_design"] == [("G", "W", *wanted, 16_000.0, 1)]
    assert found["method"] == "discrete"
    assert (found["gamma"], found["gamma_min"], found["closed_loop_norm"]) == (0.8, 0.7, 0.79)
    rates = [64_000.0, 32_000.0, 16_000.0, 8_000.0, 4_000.0]
    assert found["gamma_min_by_rate"] == [{"rate_hz": rate, "gamma_min": rate / 1e4} for rate in rates]
    assert found["continuous_sampled"] == {**LOOP_FIGURES, "closed_loop_norm": None}
    assert solvers.asked["discrete_plant"] == [("G", "W", 16_000.0, 1)]


def test_a_gamma_below_what_the_sampled_plant_allows_is_refused(solvers: Solvers) -> None:
    with pytest.raises(BadInput) as caught:
        sampled_design(request(discrete=True, gamma=0.79), 1.0, DESIGN, OTHER, 200.0)
    assert str(caught.value) == (
        "--gamma: found 0.79, expected more than gamma_min = 0.7 of the plant sampled at 16000 Hz; sample "
        "faster, shorten the delay, or lower the crossing of w1"
    )
    assert "sampled_figures" not in solvers.asked


def test_a_continuous_controller_that_has_no_sampled_form_is_told_unstable(
    solvers: Solvers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tustin(controller: Any, *_: Any) -> Any:
        if controller is OWN:
            raise ValueError("too low")
        return controller

    monkeypatch.setattr(design, "tustin", tustin)
    _, found = sampled_design(request(discrete=True), 1.0, DESIGN, OTHER, 200.0)
    assert found["continuous_sampled"] == {"spectral_radius": None}
    assert solvers.radii != []


@pytest.mark.parametrize("stable", [True, False])
def test_the_box_of_motors_is_told(monkeypatch: pytest.MonkeyPatch, stable: bool) -> None:
    weighted = SimpleNamespace(reached=2.0, bound=math.inf, resistance_ohm=1.5, inductance_h=0.004)
    robust = SimpleNamespace(
        stable=stable,
        real_mu_peak=0.8,
        worst_modulus_margin=0.5,
        sensitivity=SimpleNamespace(bound=4.0),
        weighted=weighted,
    )
    asked: list[Any] = []
    monkeypatch.setattr(design, "axis_robustness", lambda *given: asked.append(given) or robust)  # type: ignore[func-returns-value]
    coupled = SimpleNamespace(certified=True, real_mu_bound=0.4, real_mu_rad_s=77.0)
    monkeypatch.setattr(design, "coupled_robustness", lambda *given: asked.append(given) or coupled)  # type: ignore[func-returns-value]
    worst = SimpleNamespace(
        rightmost_pole_per_s=-9.0, resistance_ohm=1.0, inductance_d_h=0.001, inductance_q_h=0.002
    )
    monkeypatch.setattr(design, "worst_motor", lambda *given: asked.append(given) or worst)  # type: ignore[func-returns-value]
    assert robust_figures(MOTOR, "q", DESIGN, OTHER, 150.0) == {
        "stable": stable,
        "real_mu_peak": 0.8,
        "worst_modulus_margin": 0.5,
        "modulus_margin_bound": 0.25,
        "worst_weighted_sensitivity": 2.0 if stable else None,
        "weighted_sensitivity_bound": None,
        "worst_resistance_ohm": 1.5,
        "worst_inductance_h": 0.004,
        "coupled": {
            "speed_rad_s": 150.0,
            "certified": True,
            "real_mu_bound": 0.4,
            "real_mu_rad_s": 77.0,
            "stable_up_to_percent": pytest.approx(125.0),
            "rightmost_pole_per_s": -9.0,
            "worst_resistance_ohm": 1.0,
            "worst_inductance_d_h": 0.001,
            "worst_inductance_q_h": 0.002,
        },
    }
    assert asked[0] == (MOTOR.resistance_ohm, MOTOR.inductance_q_h, OWN, "W")
    assert asked[1] == asked[2] == (MOTOR, OTHER.controller, OWN, 150.0)


@pytest.mark.parametrize(
    ("changes", "gamma"),
    [({}, 1.0), ({"gamma": 2.0}, 2.0), ({"gamma": 0.5}, 0.5), ({"gamma_factor": 1.5}, 1.2),
     ({"gamma_factor": 1.0005}, 1.0005 * 0.8), ({"gamma": 2.0, "gamma_factor": 1.5}, 1.2)],
)  # fmt: skip
def test_the_norm_to_stay_below_is_what_was_asked_or_one(changes: dict[str, float], gamma: float) -> None:
    assert studies._gamma(request(**changes), 0.8) == pytest.approx(gamma)


@pytest.mark.parametrize(
    ("changes", "least", "told"),
    [
        ({"gamma": 0.8}, 0.8, "--gamma: found 0.8"),
        ({"gamma": 0.8 * 1.0004}, 0.8, "--gamma: found 0.80032"),
        ({"gamma_factor": 1.0}, 0.8, "--gamma-factor: found 1.0"),
        ({}, 0.9999, "--gamma: found 1.0"),
    ],
)
def test_next_to_the_least_norm_no_controller_can_be_run(
    changes: dict[str, float], least: float, told: str
) -> None:
    with pytest.raises(BadInput) as caught:
        studies._gamma(request(**changes), least)
    assert str(caught.value) == (
        f"{told}, expected at least 1.0005 times gamma_min = {least:.9g}; "
        "at gamma_min itself a pole of the controller runs to infinity"
    )


FORM = SimpleNamespace(gain=2.5, zeros=np.array([-3.0 + 0j]), poles=np.array([-1.0 + 2.0j, -1.0 - 2.0j]))


def result(sampled: Any = None) -> Any:
    chosen = SimpleNamespace(form=FORM, margins=MARGINS)
    return studies.CurrentResult(DESIGN, chosen, sampled, {})  # type: ignore[arg-type]


def test_a_controller_is_written_as_it_is_to_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "zpk", lambda _sampled: FORM)
    text = studies.controller_text(result(), "d")
    assert 'kind = "continuous"' in text
    assert 'axis = "d"' in text
    assert "gain = 2.5" in text
    assert "prewarp_rad_s = 30.0" in text
    assert "zeros_rad_s" in text
    assert "poles_rad_s" in text
    text = studies.controller_text(result(SimpleNamespace(period_s=1 / 16_000)), "q")
    assert 'kind = "sampled"' in text
    assert "sample_rate_hz = 16000\n" in text
    assert "zeros_z" in text
    assert "poles_z" in text


def test_an_order_that_cannot_be_had_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def reduced(*given: Any) -> str:
        if given[1] > 3:
            raise ValueError("at most 3")
        return f"of order {given[1]} by {given[2].value}"

    monkeypatch.setattr(studies, "reduced_design", reduced)
    assert studies._reduced(DESIGN, request()) is None
    told: Any = studies._reduced(DESIGN, request(order=3))
    assert told == f"of order 3 by {Method.PAPER.value}"
    with pytest.raises(BadInput) as caught:
        studies._reduced(DESIGN, request(order=4))
    assert str(caught.value) == "--reduce: found 4, expected at most 3"
