"""Which way the shaft turns, and what its units are worth: the steps on a shaft that is known."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.hil.commissioning import steps_units
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.identify import Array, SpeedRatio
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_units import MotionUnits, Polarity, _nudges
from servobench.hil.loop.scenario import Quantity
from tests.unit.hil.simulated_shaft import (
    LIMITS,
    VELOCITY_RAD_S,
    Objects,
    Shaft,
    session_of,
    shaft_of,
)

TRUTH = shaft_of(8e-4, 2e-3, 0.05)
POLARITY = (Object.POLARITY, 0)


def run(step: Any, session: Session) -> StepOutcome:
    outcome = StepOutcome()
    step.run(session, outcome)
    return outcome


def polarity(shaft: Shaft) -> tuple[Session, StepOutcome]:
    session = session_of(shaft)
    return session, run(Polarity(), session)


def times_configured(session: Session) -> int:
    return len(cast(Any, session).configured)


# ---- direction -----------------------------------------------------------------------------------------


def test_a_shaft_that_turns_as_it_is_told_needs_nothing() -> None:
    session, outcome = polarity(Shaft(TRUTH, Objects({POLARITY: 0})))
    assert outcome.figures == {"position_sign": 1, "velocity_sign": 1}
    assert outcome.faults == []
    assert [line.split(" turns")[0][:14] for line in outcome.lines[:2]] == [
        "set-point +: +",
        "set-point -: -",
    ]
    assert outcome.lines[2:] == [
        "positive set-points turn the shaft towards positive positions, at positive velocity"
    ]
    assert times_configured(session) == 0


@pytest.mark.parametrize("held", [None, 0x00])
@pytest.mark.parametrize(
    ("position", "velocity", "torque_sign", "velocity_sign"),
    [(-1, 1.0, -1.0, 1.0), (-1, -1.0, -1.0, -1.0), (1, -1.0, 1.0, -1.0)],
)
def test_without_607eh_or_with_one_that_will_not_the_bench_turns_the_signs(
    held: int | None, position: int, velocity: float, torque_sign: float, velocity_sign: float
) -> None:
    objects = Objects({} if held is None else {POLARITY: held})
    objects.stubborn.add(Object.POLARITY)
    session, outcome = polarity(Shaft(TRUTH, objects, position_sign=position, velocity_factor=velocity))
    override = session.found.override
    assert (override.torque_sign, override.velocity_sign) == (torque_sign, velocity_sign)
    assert outcome.lines[-1] == "607Eh does not help; the bench turns the signs itself"
    assert "607Eh" not in outcome.faults[0]
    assert times_configured(session) == 1
    assert len(objects.written) == (0 if held is None else 1)


class Inert(Objects):
    """607Eh takes what is written, and the drive minds it not at all."""

    def __init__(self) -> None:
        super().__init__({POLARITY: 0})

    def write(self, index: int, sub: int, code: str, value: int) -> None:
        super().write(index, sub, code, value)
        self.told, self.held = dict(self.held), {}

    def read_if_there(self, index: int, sub: int = 0, _code: str = "I") -> int | None:
        return {**self.held, **getattr(self, "told", {})}.get((index, sub))

    def write_verified(self, index: int, sub: int, code: str, value: int) -> None:
        self.write(index, sub, code, value)


def test_a_607eh_that_changes_nothing_is_put_back() -> None:
    objects = Inert()
    session, outcome = polarity(Shaft(TRUTH, objects, position_sign=-1))
    assert objects.written == [(Object.POLARITY, 0, "B", 0xC0), (Object.POLARITY, 0, "B", 0x00)]
    assert session.found.override.torque_sign == -1.0
    assert outcome.lines[-1] == "607Eh does not help; the bench turns the signs itself"
    assert times_configured(session) == 2


def test_a_shaft_that_turns_the_same_way_for_both_signs_fails() -> None:
    with pytest.raises(StepFailed) as caught:
        polarity(Shaft(TRUTH, one_way=True))
    assert caught.value.summary == "the shaft turns the same way for both signs"
    first, second = caught.value.evidence.split("; ")
    assert first.startswith("set-point +: +")
    assert second.startswith("set-point -: +")


def test_a_velocity_that_stays_at_0_fails() -> None:
    with pytest.raises(StepFailed, match=r"^the velocity 606Ch stays at 0 while the position changes$"):
        polarity(Shaft(TRUTH, velocity_factor=0.0))


def test_a_shaft_that_does_not_turn_fails_with_what_was_tried() -> None:
    with pytest.raises(StepFailed) as caught:
        polarity(Shaft(TRUTH, blocked=True))
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        f"the shaft does not turn with {LIMITS.torque_nm:.4g} N m",
        "0.00000 turns",
        "a brake, or a blocked shaft? limits.torque_max_percent in the nameplate allows more",
    )


def test_a_drive_of_speeds_is_tried_by_speeds() -> None:
    shaft = Shaft(TRUTH, quantity=Quantity.SPEED, mode=Mode.CYCLIC_SYNCHRONOUS_VELOCITY)
    _, outcome = polarity(shaft)
    assert outcome.figures == {"position_sign": 1, "velocity_sign": 1}
    assert shaft.runs == 2, "one each way was far enough"


def test_the_plans_tell_what_is_tried() -> None:
    torques = session_of(Shaft(TRUTH))
    speeds = session_of(Shaft(TRUTH, quantity=Quantity.SPEED))
    assert Polarity().plan(torques) == (
        "raise the torque slowly, up to 0.8 N m, until the shaft turns 0.05 turns, the same backwards; then "
        "put 607Eh right"
    )
    assert Polarity().plan(speeds) == "turn a few hundredths of a turn each way at up to 7.85 rad/s"
    assert MotionUnits().plan(torques) == "turn 0.25 turns each way and compare the velocity with the path"


# ---- nudges --------------------------------------------------------------------------------------------


class Slow(Shaft):
    """Turns by a part of the speed that it is given, and notes those."""

    def __init__(self, part: float) -> None:
        super().__init__(shaft_of(part * 8e-4), quantity=Quantity.SPEED)
        self.part = part
        self.asked: list[float] = []

    def run_speeds(self, duration: float, reference: Any = None, guard_speed: bool = True) -> Any:
        assert not guard_speed, "the unit of the speed is not known"
        self.asked.append(max((each.level for each in reference), key=abs))
        slower = [replace(each, level=self.part * each.level) for each in reference]
        return super().run_speeds(duration, slower)


@pytest.mark.parametrize(
    ("part", "tries", "moved"),
    [(1.0, 1, 0.36), (0.42, 1, 0.1512), (0.3, 2, 0.216), (0.08, 3, 0.1728), (0.02, 4, 0.1296)],
)
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_nudge_is_three_times_as_fast_as_the_last_until_it_leads_half_of_the_way(
    part: float, tries: int, moved: float, direction: float
) -> None:
    shaft = Slow(part)
    recording = _nudges(cast(Any, shaft), direction, 0.3)
    first = min(0.02 * LIMITS.speed_rad_s, 0.6)
    assert shaft.asked == pytest.approx([direction * first * 3.0**number for number in range(tries)])
    assert recording.position[-1] == pytest.approx(direction * moved)


# ---- velocity over path ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "plain", "tolerated"),
    [(1.0, 1.0, True), (1.029, 1.0, True), (10.0, 10.0, False), (0.25, 0.25, False)],
)
def test_velocity_and_position_that_contradict_each_other(
    factor: float, plain: float, tolerated: bool
) -> None:
    session = session_of(Shaft(TRUTH, velocity_factor=factor))
    outcome = run(MotionUnits(), session)
    measured = session.found.velocity_ratio
    assert measured is not None
    assert measured.value == pytest.approx(factor, rel=0.01)
    assert outcome.figures == {
        "velocity_over_path": measured.value,
        "velocity_over_path_error": measured.error,
    }
    assert outcome.lines[0] == (
        f"velocity 606Ch is {measured.value:.4g} of the slope of the position 6064h +- "
        f"{100.0 * measured.error:.2g} % (k = 2)"
    )
    rough = session.found.rough
    assert rough is not None
    assert rough.inertia_kg_m2 == pytest.approx(TRUTH.inertia_kg_m2, rel=0.2)
    assert outcome.lines[1:] == [
        f"for a start: inertia {rough.inertia_kg_m2:.3g} kg m^2, friction {rough.coulomb_friction_nm:.3g} N m"
    ]
    if tolerated:
        assert (outcome.faults, session.found.override.velocity_rad_s) == ([], None)
        return
    assert outcome.faults == [
        f"velocity and position units contradict each other by {plain:g}; "
        "unless a turn was measured below, the velocity's is taken for the wrong one"
    ]
    assert session.found.override.velocity_rad_s == pytest.approx(VELOCITY_RAD_S / plain)
    assert times_configured(session) == 1


def test_a_unit_that_was_put_right_before_is_no_part_of_the_ratio() -> None:
    """The readings are by the override, the ratio by what the drive tells."""
    session = session_of(Shaft(TRUTH), velocity_rad_s=VELOCITY_RAD_S / 10.0)
    run(MotionUnits(), session)
    assert session.found.velocity_ratio is not None
    assert session.found.velocity_ratio.value == pytest.approx(10.0, rel=0.01)


def compared(monkeypatch: pytest.MonkeyPatch, ratio: SpeedRatio, units: float = 100.0) -> Session:
    """A session in which pulses show this ratio, and a velocity of so many units."""
    session = session_of(Shaft(TRUTH, quantity=Quantity.SPEED))
    shown = replace(still_at(0.0), velocity=np.full(10, units * VELOCITY_RAD_S))
    monkeypatch.setattr(steps_units, "ratio_of", lambda _records: ratio)
    monkeypatch.setattr(steps_units, "pulses", lambda _session, _turns: [shown])
    return session


def still_at(speed_rad_s: float) -> Recording:
    """At one speed, for ten cycles."""
    time: Array = np.linspace(0.0, 0.009, 10)
    nothing = np.zeros(10)
    return Recording(time, speed_rad_s * time, nothing, nothing, nothing, 10, 0, ())


SHARE = 0.5 * LIMITS.speed_rad_s


@pytest.mark.parametrize(
    ("error", "speed", "looks"),
    [
        (0.01, 0.0, [0.25]),
        (0.0101, 0.0, [0.25, 1.0, 4.0, 16.0]),
        (0.0101, -SHARE, [0.25]),
        (0.0101, SHARE / math.sqrt(1.51), [0.25, 0.3775, 0.3775 * 1.51, 0.3775 * 1.51**2]),
        (0.0101, -SHARE / math.sqrt(1.49), [0.25]),
        (0.0101, SHARE / 2.1, [0.25, 1.0, 4.0, 16.0]),
        (math.nan, SHARE, [0.25]),
    ],
)
def test_pulses_lead_up_to_four_times_as_far_until_the_ratio_is_known_or_the_shaft_is_fast(
    monkeypatch: pytest.MonkeyPatch, error: float, speed: float, looks: list[float]
) -> None:
    """Its speed goes with the root of the path, up to half of the limit."""
    asked: list[float] = []

    def pulses(_session: Session, turns: float) -> list[Recording]:
        asked.append(turns)
        return [still_at(0.0), still_at(speed)]

    monkeypatch.setattr(steps_units, "pulses", pulses)
    monkeypatch.setattr(steps_units, "ratio_of", lambda _records: SpeedRatio(1.0, error))
    steps_units._compared(session_of(Shaft(TRUTH)), 0.25, 0.01)
    assert asked == pytest.approx(looks)


def test_a_velocity_of_few_units_is_not_said_to_scatter(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StepFailed) as caught:
        run(MotionUnits(), compared(monkeypatch, SpeedRatio(1.0, 0.2), units=9.0))
    assert caught.value.summary == "the velocity 606Ch is too coarse for its unit to be told from this motion"
    assert caught.value.evidence == f"it shows 9 units at most, of {VELOCITY_RAD_S:.4g} rad/s (60A9h)"
    with pytest.raises(StepFailed, match="scatters too much"):
        run(MotionUnits(), compared(monkeypatch, SpeedRatio(1.0, 0.2), units=10.5))
