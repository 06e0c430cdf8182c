"""The steps that set a drive up, and enable it at rest."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.cia402.mode_control import ModeRefused
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import PlanImpossible, mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.errors import NoAnswer
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_setup import EnableAtZero, SetUp, _extra_limits
from servobench.hil.loop.scenario import Quantity
from tests.unit.hil.simulated_shaft import (
    LIMITS,
    PERIOD,
    POSITION_RAD,
    WATCHED,
    Objects,
    Shaft,
    session_of,
    shaft_of,
)

TRUTH = shaft_of(1e-3)
CST, PT, CSV = Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.PROFILE_TORQUE, Mode.CYCLIC_SYNCHRONOUS_VELOCITY

# ---- limits and the mode ---------------------------------------------------------------------------------


def setting_up(*modes: Mode, refusals: dict[Mode, Exception] | None = None) -> Session:
    """A session whose drive takes those of ``modes`` that are no ``refusals``."""
    shaft = Shaft(TRUTH)
    session = session_of(shaft)
    session.found.modes = modes
    drive: Any = session.drive

    def configure(mode: Mode) -> list[str]:
        refusal = (refusals or {}).get(mode)
        if refusal is not None:
            raise refusal
        drive.plan = mode_plan(5, PlanWish(mode, coherent=True))
        return [f"a note on {mode.name}"]

    for name, value in {
        "configure": configure,
        "motion_mode": lambda: next(iter(session.found.modes), None),
    }.items():
        setattr(session, name, value)
    return session


def test_what_is_set_up_is_told_and_each_pdo() -> None:
    session, outcome = setting_up(CST), StepOutcome()
    SetUp().run(session, outcome)
    plan = mode_plan(5, PlanWish(CST, coherent=True))
    load = budget_of([plan], PERIOD, 1_000_000).load_percent
    missing = [line for line in outcome.lines if "is missing" in line]
    assert outcome.lines == [
        "a note on CYCLIC_SYNCHRONOUS_TORQUE",
        *missing,
        "TPDO1 185h type 1: 6041h/16 6077h/16 6064h/32",
        "TPDO2 285h type 1: 606Ch/32 1013h/32",
        "TPDO3 385h type 255: 6061h/8",
        "RPDO1 205h type 255: 6040h/16 6071h/16",
        f"mode cyclic synchronous torque; at most {load:.0f} % bus load; all read back",
    ]
    assert [line[:5] for line in missing] == ["605Dh", "6065h"]
    assert outcome.headline == outcome.lines[-1]
    assert outcome.figures == {"mode": "cyclic_synchronous_torque", "bus_load_percent_max": load}


def test_the_plan_tells_the_limits() -> None:
    speed = LIMITS.speed_rad_s
    assert SetUp().plan(setting_up(CST)) == (
        "write heartbeats (1016h, 1017h), reactions (6007h, 605Ah to 605Eh), ramps that are too slow (6083h, "
        "6084h, 6087h, 60C5h, 60C6h), limits (6072h, 6073h, 6080h, "
        f"607Dh, 6065h) to {LIMITS.torque_nm:.4g} N m and {speed:.4g} rad/s, and the PDOs"
    )


def impossible() -> NoAnswer:
    """What a drive says that keeps its mappings, which cannot serve the mode."""
    error = NoAnswer("it does not take the mapping")
    error.__cause__ = PlanImpossible("no PDO for it")
    return error


@pytest.mark.parametrize("refusal", [ModeRefused("it has none"), PlanImpossible("no PDO"), impossible()])
def test_the_next_mode_is_tried_where_one_is_not_taken(refusal: Exception) -> None:
    session, outcome = setting_up(CST, PT, CSV, refusals={CST: refusal, PT: refusal}), StepOutcome()
    assert SetUp()._first_mode_taken(session, outcome) is CSV
    assert session.found.modes == (CSV,)
    assert outcome.lines == [
        f"{CST.title} is not taken: {refusal}",
        f"{PT.title} is not taken: {refusal}",
        "a note on CYCLIC_SYNCHRONOUS_VELOCITY",
    ]


def test_a_drive_that_takes_no_mode_ends_it() -> None:
    refusals: dict[Mode, Exception] = {CST: ModeRefused("it has none"), PT: ModeRefused("nor this")}
    with pytest.raises(StepFailed) as caught:
        SetUp().run(setting_up(CST, PT, refusals=refusals), StepOutcome())
    assert caught.value.summary == "the drive takes none of the modes in which the bench could move it"
    assert caught.value.evidence == f"{CST.title}: it has none; {PT.title}: nor this"


def test_what_is_no_matter_of_the_mode_ends_it_at_once() -> None:
    silence = NoAnswer("nothing came")
    session = setting_up(CST, PT, refusals={CST: silence})
    with pytest.raises(NoAnswer) as caught:
        SetUp().run(session, StepOutcome())
    assert caught.value is silence
    assert session.found.modes == (CST, PT)


CURRENT, SLOPE = (Object.MAX_CURRENT, 0), (Object.TORQUE_SLOPE, 0)
HALT, WINDOW = (Object.HALT_OPTION, 0), (Object.FOLLOWING_ERROR_WINDOW, 0)


def limited(mode: Mode = CST, held_current: int = 2000, **limits: float) -> Objects:
    objects = Objects({CURRENT: held_current, SLOPE: 0, HALT: 0, WINDOW: 0})
    session = session_of(Shaft(TRUTH, objects, mode=mode), limits=replace(LIMITS, **limits))
    assert _extra_limits(session) == []
    return objects


@pytest.mark.parametrize(("held", "written"), [(499, 499), (500, 500), (501, 500), (0xFFFF, 500)])
def test_the_current_is_lowered_to_the_share_of_the_torque_and_never_raised(held: int, written: int) -> None:
    objects = limited(held_current=held)
    assert objects.held[CURRENT] == written
    assert ((Object.MAX_CURRENT, 0, "H", 500) in objects.written) is (held > 500)


def test_a_share_has_16_bits() -> None:
    assert limited(held_current=0x1_0000, torque_nm=1e6).held[CURRENT] == 0xFFFF


@pytest.mark.parametrize(
    ("following_rad", "units"), [(POSITION_RAD / 10.0, 1), (3.0 * POSITION_RAD, 3), (1e9, 0xFFFF_FFFE)]
)
def test_a_window_is_never_none_and_never_off(following_rad: float, units: int) -> None:
    """0 is no error at all, FFFF FFFFh no watch over it."""
    assert limited(following_rad=following_rad).held[WINDOW] == units


# ---- enabled at rest -------------------------------------------------------------------------------------


class Resting(Shaft):
    """Stands at these positions."""

    positions: tuple[float, ...] = ()
    torque = 0.25

    def rest(self, duration: float) -> Recording:
        assert duration == 0.3
        place = np.array(self.positions)
        torque = np.full(len(place), self.torque)
        return Recording(place, place, place, torque, place, len(place), 0, ())


def resting(*turns: float, torque: float = 0.25) -> StepOutcome:
    shaft, outcome = Resting(TRUTH), StepOutcome()
    shaft.positions, shaft.torque = tuple(math.tau * each for each in turns), torque
    EnableAtZero().run(session_of(shaft), outcome)
    return outcome


@pytest.mark.parametrize(
    ("torque", "told"), [(0.25, "mean torque 0.25 N m"), (math.nan, "no torque is told")]
)
def test_a_shaft_that_stands_within_a_hundredth_of_a_turn(torque: float, told: str) -> None:
    outcome = resting(0.5, 0.5049, 0.495, torque=torque)
    assert outcome.lines == [f"the shaft turned by 0.00990 turns; {told}", WATCHED]
    assert outcome.figures == {"crept_turns": pytest.approx(0.0099)}
    with pytest.raises(StepFailed) as caught:
        resting(0.5, 0.49, 0.501, torque=torque)
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "the shaft creeps by 0.011 turns in 0.3 s",
        told,
        "take the load off, or hold it: the figures would be worth nothing",
    )


def test_no_reading_is_no_rest() -> None:
    with pytest.raises(StepFailed, match=r"^no reading came while the drive was enabled$"):
        resting()


@pytest.mark.parametrize(("quantity", "what"), [(Quantity.TORQUE, "torque"), (Quantity.SPEED, "speed")])
def test_the_plan_of_a_rest(quantity: Quantity, what: str) -> None:
    told = f"enable with {what} 0 for 0.3 s; the shaft must stay within 0.01 turns"
    assert EnableAtZero().plan(session_of(Shaft(TRUTH, quantity=quantity))) == told
