"""The back-EMF against the DC link: where the voltage gives out, and what is said of it."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import ReadingsLost, Stated, StatedFigure, StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_voltage import (
    RunUp,
    VoltageConstant,
    _constant,
    _ending_rad_s,
    _judge,
    dc_link_v,
)
from servobench.hil.loop.protocol import TorqueSetPoint
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.scenario import Quantity
from tests.unit.hil.cycles import in_cycle
from tests.unit.hil.simulated_shaft import LIMITS, RATED_NM, Objects, Shaft, request_of, session_of, shaft_of

TRUTH = shaft_of(8e-4, 1e-3, 0.05)
DC_LINK = (Object.DC_LINK_CIRCUIT_VOLTAGE, 0)
LINK_V = 48.0


class Limited(Shaft):
    """Turns no faster than its voltage lets it."""

    speed_max_rad_s = math.inf

    def _on(self, angle: float, speed: float, asked: float) -> tuple[float, float, float]:
        later = min(super()._on(angle, speed, asked)[1], self.speed_max_rad_s)
        return angle + 0.5 * (speed + later) * self.period_s, later, asked


def session(
    speed_max_rad_s: float = math.inf,
    raw_mv: int | None = 48_000,
    lost: int = 0,
    rating: dict[str, float] | None = None,
) -> Session:
    objects = Objects({} if raw_mv is None else {DC_LINK: raw_mv})
    shaft = Limited(TRUTH, objects, lost=lost)
    shaft.speed_max_rad_s = speed_max_rad_s
    made = session_of(shaft, request=request_of({"rating": rating or {}}), mechanics=TRUTH)
    made.found.mechanics = TRUTH
    return made


def test_the_speed_at_which_the_voltage_gives_out_tells_the_constant() -> None:
    outcome, speed = StepOutcome(), 0.6 * LIMITS.speed_rad_s
    made = session(speed)
    made.found.torque_constant_nm_a = 1.5 * math.sqrt(2.0) * LINK_V / math.sqrt(3.0) / speed
    VoltageConstant().run(made, outcome)
    constant = LINK_V / math.sqrt(3.0) / speed
    found = outcome.figures
    assert found["limited"] is True
    assert found["dc_link_v"] == LINK_V
    assert found["speed_rad_s"] == pytest.approx(speed)
    assert found["voltage_constant"] == pytest.approx(constant)
    assert found["by_torque_constant"] == pytest.approx(constant)
    assert outcome.lines == [
        "6079h tells 48 V: at most 27.71 V a phase, peak",
        f"pushed on, the shaft turns no faster than {speed / RAD_S_PER_RPM:.0f} r/min",
        f"voltage constant {constant:.4g} V s/rad +- {found['voltage_constant_error']:.2g} (k = 2; phase, "
        f"peak, by space-vector modulation), {constant * math.sqrt(1.5) * 1000.0 * RAD_S_PER_RPM:.4g} V per "
        "1000 r/min between two phases, rms",
        f"by the torque constant it is {constant:.4g} V s/rad",
    ]
    assert outcome.headline == outcome.lines[2]


def test_where_the_limit_of_speed_comes_first_the_constant_is_bounded() -> None:
    outcome = StepOutcome()
    VoltageConstant().run(session(), outcome)
    speed = outcome.figures["speed_rad_s"]
    bound = LINK_V / math.sqrt(3.0) / speed
    assert outcome.figures == {
        "dc_link_v": LINK_V,
        "speed_rad_s": pytest.approx(0.95 * LIMITS.speed_rad_s, rel=0.05),
        "limited": False,
        "voltage_constant_below": pytest.approx(bound),
    }
    assert outcome.lines[1:] == [
        f"the voltage does not give out below {speed / RAD_S_PER_RPM:.0f} r/min, near the limit of speed: "
        f"the voltage constant is less than {bound:.4g} V s/rad (phase, peak)",
        "no torque constant was measured to hold it against",
    ]


def test_readings_that_are_lost_end_it() -> None:
    with pytest.raises(ReadingsLost):
        VoltageConstant().run(session(lost=10**6), StepOutcome())


@pytest.mark.parametrize(
    ("travel", "raw_mv", "quantity", "reason"),
    [
        (math.inf, 48_000, Quantity.TORQUE, None),
        (math.inf, 48_000, Quantity.SPEED, "the drive has no torque mode"),
        (
            math.inf,
            0,
            Quantity.TORQUE,
            "the drive tells no DC link voltage 6079h: its voltage constant cannot be measured",
        ),
        (1.501, 48_000, Quantity.TORQUE, None),
        (1.499, 48_000, Quantity.TORQUE, "the run-up takes 28.1 turns, more than is allowed"),
    ],
)
def test_what_it_needs(travel: float, raw_mv: int, quantity: Quantity, reason: str | None) -> None:
    """The run-up: J w over 0.3 of the torque limit, and four looks; at the limit of speed."""
    run_up_s = 8e-4 * LIMITS.speed_rad_s / (0.3 * LIMITS.torque_nm)
    path_rad = LIMITS.speed_rad_s * (run_up_s + 0.6)
    made = session(raw_mv=raw_mv)
    changed = cast(Any, made)
    changed.limits = replace(LIMITS, travel_rad=travel * path_rad)
    if quantity is Quantity.SPEED:
        changed.torque_mode = lambda: None
    expected = reason
    if reason is not None and "run-up" in reason:
        expected = f"the run-up takes {path_rad / math.tau:.1f} turns, more than is allowed"
    assert VoltageConstant().left_out(made) == expected
    made.found.mechanics = None
    if reason is None or "run-up" in reason:
        assert VoltageConstant().left_out(made) is None, "nothing is known of the shaft yet"


def test_the_plan_tells_the_push_as_soon_as_it_is_known() -> None:
    """Friction at the limit of speed, and 0.3 of the torque limit."""
    made = session()
    push = 0.05 + 1e-3 * LIMITS.speed_rad_s + 0.3 * LIMITS.torque_nm
    assert VoltageConstant().plan(made) == f"push the shaft up to 1425 r/min with {push:.3g} N m; read 6079h"
    made.found.mechanics = None
    assert VoltageConstant().plan(made) == "push the shaft up to 1425 r/min; read 6079h"


# ---- the DC link -----------------------------------------------------------------------------------------

REMEDY = "measure the DC link: 6079h is in mV, or the nameplate's dc_bus_voltage_v is wrong"


@pytest.mark.parametrize(
    ("raw_mv", "rating", "evidence"),
    [
        (5_000, {}, None),
        (4_999, {}, "a motor needs 5 to 1500 V"),
        (1_500_000, {}, None),
        (1_500_001, {}, "a motor needs 5 to 1500 V"),
        (None, {}, "a motor needs 5 to 1500 V"),
        (72_000, {"dc_bus_voltage_v": 48.0}, None),
        (72_001, {"dc_bus_voltage_v": 48.0}, "the nameplate says 48 V; within 32 to 72 V"),
        (32_000, {"dc_bus_voltage_v": 48.0}, None),
        (31_999, {"dc_bus_voltage_v": 48.0}, "the nameplate says 48 V; within 32 to 72 V"),
    ],
)
def test_a_dc_link_is_one_of_a_motor_or_within_half_of_the_nameplates(
    raw_mv: int | None, rating: dict[str, float], evidence: str | None
) -> None:
    made = session(raw_mv=raw_mv, rating=rating)
    link_v = (raw_mv or 0) / 1000.0
    if evidence is None:
        assert dc_link_v(made) == link_v
        return
    with pytest.raises(StepFailed) as caught:
        dc_link_v(made)
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        f"6079h tells {link_v:g} V of DC link",
        evidence,
        REMEDY,
    )


# ---- the constant ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("resistance_ohm", "per_a"), [(None, None), (0.5, None), (None, 0.1), (0.5, 0.1)])
def test_what_the_winding_drops_is_taken_off_where_it_is_known(
    resistance_ohm: float | None, per_a: float | None
) -> None:
    """At a speed that stays friction alone makes current; else 8 % of the voltage at the rated torque."""
    made, outcome = session(), StepOutcome()
    made.found.torque_constant_nm_a = per_a
    if resistance_ohm is not None:
        made.found.stated["resistance_ohm"] = Stated(resistance_ohm, "by the nameplate")
    friction = 0.05 + 1e-3 * 100.0
    drop_v, unsure_v = 0.0, 0.08 * 30.0 * friction / RATED_NM
    if resistance_ohm is not None and per_a is not None:
        drop_v = 0.5 * math.sqrt(2.0) * friction / 0.1
        unsure_v = 0.3 * drop_v
    constant = (30.0 - drop_v) / 100.0
    error = constant * math.sqrt(0.05**2 + (unsure_v / 30.0) ** 2)
    assert _constant(made, 30.0, 100.0, outcome) == pytest.approx(constant)
    assert outcome.figures == {
        "voltage_constant": pytest.approx(constant),
        "voltage_constant_error": pytest.approx(error),
    }
    first, second = outcome.quantities
    assert first == StatedFigure("speed at the voltage limit", 100.0 / RAD_S_PER_RPM, "r/min")
    assert second.name == "voltage constant, phase, peak"
    assert [second.value, second.uncertainty] == pytest.approx([constant, error])
    assert second.unit == "V s/rad"


@pytest.mark.parametrize(
    ("least", "most", "expected", "by"),
    [
        (0.2, 0.2, 0.2, None),
        (0.2, 0.2, 0.2999, None),
        (0.2, 0.2, 0.3001, 1.5005),
        (0.2, 0.2, 0.1334, None),
        (0.2, 0.2, 0.1333, 1.500375),
        (0.0, 0.2, 0.01, None),
        (0.0, 0.2, 0.2999, None),
        (0.0, 0.2, 0.4, 2.0),
    ],
)
def test_torque_constant_and_dc_link_may_differ_by_half(
    least: float, most: float, expected: float, by: float | None
) -> None:
    outcome = StepOutcome()
    if by is None:
        _judge(least, most, expected, outcome)
    else:
        with pytest.raises(StepFailed) as caught:
            _judge(least, most, expected, outcome)
        assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
            f"torque constant and DC link contradict each other by {by:.3g}",
            f"by the torque constant it is {expected:.4g} V s/rad",
            "6076h, 6075h, or torque_nm or current_a of the nameplate is wrong, on which every torque here "
            "rests (or the drive weakens the field)",
        )
    assert outcome.figures == {"by_torque_constant": expected}
    assert outcome.lines == [f"by the torque constant it is {expected:.4g} V s/rad"]


# ---- the run-up ------------------------------------------------------------------------------------------


class Watch:
    """A run-up of 0.8 N m by 0.2 N m a cycle to 100 rad/s, at a speed as a function of time."""

    def __init__(self, slow: float = 50.0) -> None:
        self.up = RunUp(0.8, 20.0, 100.0, 0.01, slow)
        self.time_s = self.position = 0.0
        self.sequence = 0
        self.torques: list[float] = []

    def go(self, duration_s: float, *, slope: float = 0.0, speed: float = 0.0) -> "Watch":
        """On for so long at a speed that begins at ``speed``, or until it is done."""
        for _ in range(round(duration_s / 0.01)):
            self.sequence += 1
            at = Instant(round(self.time_s * NS_PER_S))
            estimate = StateEstimate(self.position, speed, 0.0, at, self.sequence)
            asked = self.up.output(in_cycle(estimate))
            assert isinstance(asked, TorqueSetPoint)
            self.torques.append(asked.torque_nm)
            if self.up.done():
                break
            self.time_s += 0.01
            self.position += (speed + 0.5 * slope * 0.01) * 0.01
            speed += slope * 0.01
        return self


def test_the_torque_rises_by_its_slope_and_stays() -> None:
    watch = Watch().go(0.08, slope=200.0)
    assert watch.torques == pytest.approx([0.2, 0.4, 0.6, 0.8, 0.8, 0.8, 0.8, 0.8])


def test_before_the_first_reading_it_is_not_judged() -> None:
    up = RunUp(0.8, 20.0, 100.0, 0.01, 50.0)
    for _ in range(100):
        up.output(in_cycle())
    assert (up.done(), up.stalled) == (False, False)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("speed", "done"), [(99.9, False), (100.0, True)])
def test_it_is_done_at_its_speed(sign: float, speed: float, done: bool) -> None:
    watch = Watch().go(0.03, speed=sign * speed)
    assert (watch.up.done(), watch.up.stalled) == (done, False)


@pytest.mark.parametrize(("slope", "stalled"), [(0.0, True), (49.0, True), (51.0, False), (-51.0, False)])
def test_a_shaft_that_gains_less_than_the_slow_has_stalled(slope: float, stalled: bool) -> None:
    """Three speeds of 0.15 s each."""
    watch = Watch().go(0.465, slope=slope, speed=30.0)
    assert watch.up.stalled is stalled
    assert watch.up.done() is stalled
    if stalled:
        assert watch.time_s == pytest.approx(0.45)


def test_a_shaft_that_is_not_pushed_on_yet_has_not_stalled() -> None:
    watch = Watch()
    watch.up = RunUp(0.8, 1.0, 100.0, 0.01, 50.0)
    watch.go(2.0, speed=30.0)
    assert watch.up.stalled
    assert watch.time_s == pytest.approx(0.90), "0.01 N m a cycle: the whole push at 0.79 s, then a look"


def test_the_speed_at_the_end_is_that_of_its_last_readings() -> None:
    time = np.linspace(0.0, 1.0, 101)
    position = np.where(time < 0.9, 10.0 * time, 9.0 - 40.0 * (time - 0.9))
    nothing = np.zeros(101)

    def ending(count: int, window_s: float) -> float:
        return _ending_rad_s(
            Recording(time[:count], position[:count], nothing, nothing, nothing, count, 0, ()), window_s
        )

    assert ending(101, 0.051) == pytest.approx(40.0)
    assert ending(81, 0.051) == pytest.approx(10.0)
    with pytest.raises(StepFailed, match=r"^too few readings came$"):
        ending(101, 0.0)
