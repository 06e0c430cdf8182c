"""Which feedback is taken for a delay, a network or a gain, and what is said where none will do."""

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servobench.design.delay.certificate import CertifiedGain
from servobench.design.delay.delay_loop import Feedback
from servobench.design.delay.lmi import SOLVED, SOLVER
from servobench.design.errors import NoSolution
from servobench.design.sampled.bandwidth_range import BandwidthRange
from servobench.design.sampled.held_loop import SampledNetwork
from servobench.design.speed.speed_design import SpeedDesign
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.studies.speed import synthesis
from servobench.hil.studies.speed.synthesis import (
    DesignRequest,
    DesignResult,
    Unreachable,
    Way,
    design_speed,
    with_bandwidths,
)
from tests.unit.hil.made_analyses import MARGINS, STAMP, made_analysis, unproved

MOTOR = LING2012.parameters
GAIN = np.array([0.0, -0.02])
EXACT = Way("exact", Feedback.SPEED, False, 0.5, False)


def request(
    gamma: float | None = 125.0,
    delay_s: float | None = 0.064,
    network: SampledNetwork | None = None,
    bandwidth_hz: float | None = 150.0,
    **way: Any,
) -> DesignRequest:
    return DesignRequest(MOTOR, gamma, delay_s, network, replace(EXACT, **way), 0.5, 40.0, bandwidth_hz)


def design(gain: float = 100.0, delay_s: float = 0.064) -> SpeedDesign:
    return SpeedDesign(GAIN, delay_s, gain)


def percent(gain: float) -> float:
    return 100.0 * gain * 0.5 / 40.0


class Methods:
    """In place of those of the design: by name what was asked, and what comes of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.least, self.largest = 100.0, 0.08
        self.reachable = True
        self.sampled = made_analysis()
        answers: dict[str, Callable[..., Any]] = {
            "least_gain": lambda delay_s, *_: design(self.least, delay_s),
            "least_certified_gain": lambda delay_s, *_: design(self.least, delay_s),
            "largest_delay": lambda gamma, *_: design(gamma, self._reached()),
            "largest_certified_delay": lambda gamma, *_: design(gamma, self._reached()),
            "largest_ccl_delay": lambda gamma: design(gamma, self._reached()),
            "least_sampled_gain": lambda *_: design(77.0, 0.024),
            "certified_gain": lambda _loop, order: CertifiedGain(101.0, order, 1e-4),
            "certified_gain_auto": lambda _loop: CertifiedGain(100.5, 2, 1e-4),
            "analyse_sampled": lambda _gain, _network: self.sampled,
        }
        for name, answer in answers.items():
            monkeypatch.setattr(synthesis, name, self._noting(name, answer))
        monkeypatch.setattr(synthesis, "hinf_norm", lambda _loop: 99.5)
        monkeypatch.setattr(synthesis, "with_peak", lambda sampled: replace(sampled, peak_found=41.0))

    def _reached(self) -> float:
        if not self.reachable:
            raise NoSolution("a delay", "there is none")
        return self.largest

    def _noting(self, name: str, answer: Callable[..., Any]) -> Callable[..., Any]:
        def asked(_model: Any, *given: Any) -> Any:
            self.asked.append((name, *(each for each in given if not hasattr(each, "A"))))
            return answer(*given)

        return asked


@pytest.fixture
def methods(monkeypatch: pytest.MonkeyPatch) -> Methods:
    return Methods(monkeypatch)


def names(methods: Methods) -> list[str]:
    return [name for name, *_ in methods.asked]


@pytest.mark.parametrize(
    ("method", "asked", "certified"),
    [
        ("exact", [("least_gain", 0.064, Feedback.SPEED, 0.5), ("certified_gain_auto",)], 100.5),
        ("lmi", [("least_certified_gain", 0.064, Feedback.SPEED), ("certified_gain", 0)], 101.0),
    ],
)
def test_for_a_delay_the_least_gain_is_taken(
    methods: Methods, method: str, asked: list[Any], certified: float
) -> None:
    done = design_speed(request(None, method=method))
    assert methods.asked == asked
    assert (done.design.delay_s, done.design.gain, done.gamma_exact) == (0.064, 100.0, 99.5)
    assert done.certified is not None
    assert done.certified.gain == certified
    assert (done.sampled, done.bandwidths) == (None, None)


@pytest.mark.parametrize(
    ("method", "asked"),
    [
        ("exact", ("largest_delay", 125.0, Feedback.SPEED, 0.5)),
        ("lmi", ("largest_certified_delay", 125.0, Feedback.SPEED)),
        ("ccl", ("largest_ccl_delay", 125.0)),
    ],
)
def test_for_a_gain_the_largest_delay_is_taken(methods: Methods, method: str, asked: tuple[Any, ...]) -> None:
    done = design_speed(request(125.0, None, method=method))
    assert methods.asked[0] == asked
    assert (done.design.delay_s, done.design.gain) == (0.08, 125.0)


def test_a_gain_that_no_delay_keeps_is_out_of_reach(methods: Methods) -> None:
    methods.reachable = False
    with pytest.raises(Unreachable) as caught:
        design_speed(request(125.0, None))
    assert methods.asked[1] == ("least_gain", 1e-6, Feedback.SPEED, 0.5)
    assert (caught.value.best.gain, caught.value.delay_needed_s) == (100.0, None)


@pytest.mark.parametrize(("least", "kept"), [(125.0, True), (125.0 * 1.0000009, True), (125.001, False)])
def test_a_gain_is_kept_up_to_a_millionth(methods: Methods, least: float, kept: bool) -> None:
    methods.least = least
    if kept:
        assert design_speed(request()).design.gain == least
        return
    with pytest.raises(Unreachable) as caught:
        design_speed(request())
    assert names(methods) == ["least_gain", "largest_delay"]
    assert (caught.value.best.gain, caught.value.delay_needed_s) == (least, 0.08)
    methods.reachable = False
    with pytest.raises(Unreachable) as caught:
        design_speed(request())
    assert caught.value.delay_needed_s is None


@pytest.mark.usefixtures("methods")
def test_with_a_network_the_sampled_loop_is_looked_at_and_its_peak() -> None:
    told: list[str] = []
    done = design_speed(request(None, network=STAMP), told.append)
    assert done.sampled is not None
    assert (done.sampled.gain_found, done.sampled.peak_found) == (100.0, 41.0)
    assert done.certified is not None
    assert told == [
        "gain and decay over every sequence of losses and delays: some 10 s",
        "largest error after a load step over every sequence: up to two minutes",
    ]
    told.clear()
    design_speed(request(None), told.append)
    assert told == []


@pytest.mark.usefixtures("methods")
@pytest.mark.parametrize(("gamma", "kept"), [(125.0, True), (124.99, False), (None, True)])
def test_the_loop_that_runs_must_keep_the_gain_too(gamma: float | None, kept: bool) -> None:
    """It is certified at 125."""
    for way in ({"for_sampled": True}, {}):
        if kept:
            done = design_speed(request(gamma, network=STAMP, **way))
            assert done.design.gain == (125.0 if way else 100.0)
            continue
        with pytest.raises(Unreachable) as caught:
            design_speed(request(gamma, network=STAMP, **way))
        assert (caught.value.best.gain, caught.value.delay_needed_s) == (125.0, None)


def test_the_sampled_loop_itself_may_be_made_best(methods: Methods) -> None:
    done = design_speed(request(None, None, network=STAMP, for_sampled=True))
    assert methods.asked == [
        ("least_sampled_gain", STAMP, Feedback.SPEED, 0.5),
        ("analyse_sampled", GAIN, STAMP),
    ]
    assert (done.design.gain, done.design.delay_s) == (125.0, 0.024)
    assert (done.certified, done.gamma_exact) == (None, 99.5)


@pytest.mark.parametrize("way", [{"for_sampled": True}, {}])
def test_a_loop_that_cannot_be_certified_is_no_design(methods: Methods, way: dict[str, bool]) -> None:
    methods.sampled = unproved("it is unstable")
    with pytest.raises(NoSolution, match="the loop that runs cannot be certified") as caught:
        design_speed(request(125.0, network=STAMP, **way))
    assert "it is unstable" in str(caught.value)


class ConeSteps:
    """Algorithm 4.2 made up: a gain of gamma reaches a delay of ``slope`` (gamma - 50); what it finds is
    certified at ``share`` of gamma."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, share: float = 1.0, slope: float = 1e-3) -> None:
        self.asked: list[float] = []
        self.share, self.slope = share, slope
        monkeypatch.setattr(synthesis, "least_certified_gain", lambda *_: design(80.0))
        monkeypatch.setattr(synthesis, "largest_ccl_delay", self.largest)
        monkeypatch.setattr(synthesis, "certified_gain", self.certified)
        monkeypatch.setattr(synthesis, "hinf_norm", lambda _loop: 1.0)

    def largest(self, _model: Any, gamma: float) -> SpeedDesign:
        self.asked.append(gamma)
        if gamma < 70.0 or not self.slope:
            raise NoSolution("a delay", "there is none")
        return SpeedDesign(np.array([0.0, -gamma]), self.slope * (gamma - 50.0), gamma)

    def certified(self, _model: Any, _loop: Any, order: int) -> CertifiedGain:
        assert order == 0
        return CertifiedGain(self.share * self.asked[-1], order, 1e-4)


@pytest.mark.parametrize(
    ("delay_s", "near"), [(0.064, 0.12), (0.1, 0.16), (0.25, 0.32), (1.0, 120.0 * (1.5**6 - 1.5**5) / 2**5)]
)
def test_the_cone_algorithm_is_bisected_for_a_delay(
    monkeypatch: pytest.MonkeyPatch, delay_s: float, near: float
) -> None:
    """The least gain is 50 + 1000 delay; it is sought from 1.5 times the certified 80 on."""
    steps = ConeSteps(monkeypatch)
    done = design_speed(request(None, delay_s, method="ccl"))
    least = 50.0 + 1e3 * delay_s
    assert steps.asked[0] == 120.0
    assert least <= done.design.gain * (1 + 1e-12)
    assert done.design.gain <= least + near, "to a thousandth, or in twelve steps"
    assert done.design.delay_s == delay_s
    assert done.design.K[1] == -done.design.gain
    assert len(steps.asked) <= 12


def test_a_certificate_better_than_what_was_asked_narrows_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = ConeSteps(monkeypatch, share=0.5)
    done = design_speed(request(None, 0.064, method="ccl"))
    assert steps.asked == [120.0], "60 is below the least certified gain: nothing is left between them"
    assert done.design.gain == 60.0


def test_a_search_that_finds_nothing_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = ConeSteps(monkeypatch, slope=0.0)
    with pytest.raises(NoSolution, match=r"Algorithm 4.2 for a delay of 64 ms"):
        design_speed(request(None, method="ccl"))
    assert len(steps.asked) == 12
    assert steps.asked == pytest.approx([120.0 * 1.5**n for n in range(12)])


def result(sampled: bool = False, bandwidths: BandwidthRange | None = None, **more: Any) -> DesignResult:
    asked = request(None, network=STAMP if sampled else None, **more)
    certified = None if more.get("for_sampled") else CertifiedGain(101.0, 2, 1e-4)
    return DesignResult(
        asked, design(), math.inf, certified, made_analysis() if sampled else None, bandwidths
    )


@pytest.fixture
def robust(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures that are made up; what they were asked of."""
    asked: list[Any] = []
    changed = {"inertia_70_percent": SimpleNamespace(gain=math.inf, gain_found=90.0)}

    def speed_robustness(*given: Any) -> Any:
        asked.extend(given)
        return SimpleNamespace(
            peak_over_floor=1.5,
            margins=MARGINS,
            delay_margin_s=0.01,
            changed=changed,
            noise_nm_s_rad=math.inf,
        )

    monkeypatch.setattr(synthesis, "speed_robustness", speed_robustness)
    return asked


def test_the_figures_of_a_design_are_whole(robust: list[Any]) -> None:
    figures = result().figures
    floor = -math.expm1(-MOTOR.viscous_friction_nm_s * 0.064 / MOTOR.inertia_kg_m2)
    floor /= MOTOR.viscous_friction_nm_s
    assert figures == {
        "feasible": True,
        "gain": [0.0, -0.02],
        "current_bandwidth_hz": 150.0,
        "gamma": 100.0,
        "delay_s": 0.064,
        "method": "exact",
        "feedback": "speed",
        "integral": False,
        "target": "constant",
        "certificate": {
            "gamma": 101.0,
            "order": 2,
            "solver": SOLVER,
            "status": SOLVED,
            "min_margin": 1e-4,
        },
        "gamma_exact": None,
        "error_percent": pytest.approx(percent(100.0)),
        "load_nm": 0.5,
        "speed_rad_s": 40.0,
        "peak_floor_percent": pytest.approx(percent(floor)),
        "robustness": {
            "peak_over_floor": 1.5,
            "gain_margin_db": 6.0,
            "phase_margin_deg": 45.0,
            "modulus_margin": 0.6,
            "delay_margin_s": 0.01,
            "inertia_70_percent": {"gamma_exact": None, "gain_found": 90.0},
            "noise_to_torque_nm_s_rad": None,
        },
    }
    plant, motor, loop, held, patterns = robust
    assert (motor, held, patterns) == (MOTOR, None, [])
    assert loop.delay_s == 0.064
    assert plant(motor, 0.5).A[0, 0] == pytest.approx(-math.pi * 150.0)


def test_the_figures_of_the_sampled_loop_stand_beside(robust: list[Any]) -> None:
    covered = BandwidthRange(100.0, 200.0, 130.0, 2.5)
    figures = result(sampled=True, bandwidths=covered, for_sampled=True).figures
    assert (figures["target"], figures["certificate"]) == (
        "sampled",
        {"solver": SOLVER, "status": "see sampled"},
    )
    assert figures["sampled"]["strategy"] == "stamp"
    assert figures["sampled"]["sequences"]["error_percent"]["certified"] == pytest.approx(percent(125.0))
    assert figures["current_bandwidths"] == {
        "min_hz": 100.0,
        "max_hz": 200.0,
        "gain": 130.0,
        "decay_per_s": 2.5,
    }
    assert robust[3].network == STAMP
    assert robust[4] == made_analysis().patterns


@pytest.fixture
def ranges(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Ranges of bandwidths that are made up; what they were asked of."""
    asked: list[Any] = []

    def any_range(model_at: Any, *given: Any) -> BandwidthRange:
        asked.extend((model_at(200.0).A[0, 0], *given))
        return BandwidthRange(100.0, 200.0, 130.0)

    monkeypatch.setattr(synthesis, "bandwidth_range", any_range)
    monkeypatch.setattr(synthesis, "constant_bandwidth_range", any_range)
    return asked


def test_the_bandwidths_are_those_for_which_the_constant_loop_is_certified(ranges: list[Any]) -> None:
    assert with_bandwidths(result()).bandwidths == BandwidthRange(100.0, 200.0, 130.0)
    assert ranges[0] == pytest.approx(-math.tau * 200.0)
    assert ranges[2:] == [0.064, BandwidthRange(150.0, 150.0, 101.0)]


def test_the_bandwidths_are_those_for_which_the_sampled_loop_is_certified(ranges: list[Any]) -> None:
    assert with_bandwidths(result(sampled=True)).bandwidths == BandwidthRange(100.0, 200.0, 130.0)
    network, patterns, nominal = ranges[2:]
    assert (network, nominal) == (STAMP, BandwidthRange(150.0, 150.0, 125.0, 3.0))
    assert patterns == made_analysis().patterns


def test_without_a_bandwidth_or_a_proof_no_others_are_looked_at(ranges: list[Any]) -> None:
    assert with_bandwidths(result(bandwidth_hz=None)).bandwidths is None
    for lacking in ("gain_proof", "decay_proof"):
        half = replace(result(sampled=True), sampled=made_analysis(STAMP, **{lacking: None}))
        assert with_bandwidths(half).bandwidths is None
    assert ranges == []
