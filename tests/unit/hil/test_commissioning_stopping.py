"""Whether a drive can stop: what its settings say, and what is written to them."""

import math
from dataclasses import replace
from typing import Any, cast

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import QuickStopOption
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_stopping import (
    StopProof,
    StopSettings,
    _proof_speed,
)
from tests.unit.hil.simulated_shaft import (
    LIMITS,
    VELOCITY_RAD_S,
    Objects,
    Shaft,
    session_of,
    shaft_of,
)

OPTION = (Object.QUICK_STOP_OPTION, 0)
QUICK, PROFILE = (Object.QUICK_STOP_DECELERATION, 0), (Object.PROFILE_DECELERATION, 0)
UNIT = VELOCITY_RAD_S
"""Of the accelerations, rad/s^2."""
SPEED = LIMITS.speed_rad_s
NEEDED = math.ceil(SPEED / 0.5 / UNIT)
"""A stop from the limit of speed in half a second."""


def asked(held: dict[tuple[int, int], int], *stubborn: int, unit: float = UNIT) -> tuple[Session, Objects]:
    objects = Objects(dict(held))
    objects.stubborn |= set(stubborn)
    return session_of(Shaft(shaft_of(1e-3), objects), acceleration_rad_s2=unit), objects


def settled(session: Session) -> StepOutcome:
    outcome = StepOutcome()
    StopSettings().run(session, outcome)
    return outcome


def told_of(option: int, raw: int | None, time_ms: float, note: str = "", unit: float = UNIT) -> str:
    held = "" if raw is None else f", 6085h = {raw} of {unit:.4g} rad/s^2"
    return f"605Ah = {option}{held}: a stop from 1500 r/min takes {time_ms:.0f} ms{note}"


# ---- settings --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("held", "quick", "option", "left"),
    [
        (2 * NEEDED, {}, {}, 2 * NEEDED),
        (2 * NEEDED, {OPTION: 2}, {}, 2 * NEEDED),
        (2 * NEEDED, {OPTION: 1}, {OPTION: 2}, 2 * NEEDED),
        (math.ceil(SPEED / 2.0 / UNIT), {}, {}, math.ceil(SPEED / 2.0 / UNIT)),
        (math.floor(SPEED / 2.0 / UNIT), {}, {QUICK: NEEDED}, NEEDED),
        (0, {}, {QUICK: NEEDED}, NEEDED),
    ],
)
def test_a_ramp_that_takes_up_to_2_s_is_left_and_another_one_written(
    held: int, quick: dict[Any, int], option: dict[Any, int], left: int
) -> None:
    session, objects = asked({QUICK: held, **quick})
    outcome = settled(session)
    assert {(index, sub): value for index, sub, _, value in objects.written} == option
    assert session.found.quick_stop_option is QuickStopOption.QUICK_STOP_RAMP
    written = QUICK in option
    assert session.found.quick_stop_rad_s2 == (pytest.approx(NEEDED * UNIT) if written else None)
    time_s = SPEED / (left * UNIT)
    assert outcome.figures == {"option": 2, "stop_s": pytest.approx(time_s)}
    assert outcome.lines == [told_of(2, left, 1e3 * time_s)]
    assert outcome.faults == []
    assert len(cast(Any, session).configured) == 1


@pytest.mark.parametrize(("time_s", "noted"), [(0.0049, True), (0.0051, False)])
def test_a_ramp_that_no_motor_follows_is_noted(time_s: float, noted: bool) -> None:
    unit = SPEED / time_s
    session, _ = asked({QUICK: 1}, unit=unit)
    note = "; less than any motor takes, so the torque decides" if noted else ""
    assert settled(session).lines == [told_of(2, 1, 1e3 * time_s, note, unit)]


def test_a_drive_without_6085h_is_measured() -> None:
    session, objects = asked({OPTION: 2})
    outcome = settled(session)
    assert outcome.figures == {"option": 2, "stop_s": None}
    assert outcome.lines == ["605Ah = 2; how long a stop takes the drive does not tell: it is measured"]
    assert objects.written == []


def test_the_current_limit_stops_where_6085h_will_not() -> None:
    session, _ = asked({OPTION: 2, QUICK: 0}, Object.QUICK_STOP_DECELERATION)
    outcome = settled(session)
    assert session.found.quick_stop_option is QuickStopOption.CURRENT_LIMIT
    assert session.found.quick_stop_rad_s2 is None
    assert outcome.faults == [
        "stops by its current limit (605Ah = 3): 6085h is 0, and 6085h:00 holds 0, "
        f"{NEEDED} was asked for (deceleration): not taken"
    ]
    assert outcome.figures == {"option": 3, "stop_s": None}
    assert outcome.lines == ["605Ah = 3; how long a stop takes the drive does not tell: it is measured"]


def test_the_slow_down_ramp_is_the_last_way() -> None:
    slow = math.floor(SPEED / 4.0 / UNIT)
    session, objects = asked({QUICK: slow, PROFILE: 2 * NEEDED}, Object.QUICK_STOP_DECELERATION)
    with pytest.raises(StepFailed) as caught:
        settled(session)
    why = (
        f"6085h is {slow}, {SPEED / (slow * UNIT):.3g} s from the limit, and 6085h:00 holds "
        f"{slow}, {NEEDED} was asked for (deceleration): not taken"
        + 2
        * "; no 605Ah to choose another stop by"
    )
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "the drive cannot be made to stop, and nothing was turned",
        why,
        "set 6085h with the maker's tool, or lower limits.speed_max_rpm in the nameplate",
    )

    class Choosy(Objects):
        """Takes every option but the current limit."""

        def write(self, index: int, sub: int, code: str, value: int) -> None:
            if (index, value) != (Object.QUICK_STOP_OPTION, 3):
                super().write(index, sub, code, value)

    for profile, left in ((2 * NEEDED, 2 * NEEDED), (0, NEEDED)):
        objects = Choosy({OPTION: 2, QUICK: slow, PROFILE: profile})
        objects.stubborn.add(Object.QUICK_STOP_DECELERATION)
        session = session_of(Shaft(shaft_of(1e-3), objects))
        outcome = settled(session)
        assert session.found.quick_stop_option is QuickStopOption.SLOW_DOWN_RAMP
        assert session.found.quick_stop_rad_s2 is None, "that is of 6085h"
        assert outcome.lines == [told_of(1, slow, 1e3 * SPEED / (left * UNIT))]
        assert outcome.faults == []
        assert (objects.held[OPTION], objects.held[PROFILE]) == (1, left)


def test_a_unit_that_makes_more_than_32_bits_is_told() -> None:
    unit = SPEED / 0.5 / (2**32 - 1)
    taken, _ = asked({QUICK: 0}, unit=unit * (1.0 + 1e-12))
    settled(taken)
    session, _ = asked({QUICK: 0}, unit=unit * (1.0 - 1e-9))
    with pytest.raises(StepFailed) as caught:
        settled(session)
    told = f"6085h is 0, and the unit that it tells, {unit:.3g} rad/s^2, makes {2**32 + 4} of 0.5 s; "
    assert caught.value.evidence.startswith(told)


def test_a_coarse_unit_is_written_once_at_least() -> None:
    session, objects = asked({QUICK: 0}, unit=1e9)
    settled(session)
    assert objects.held[QUICK] == 1


def test_the_plans_tell_speeds() -> None:
    session, _ = asked({})
    assert StopSettings().plan(session) == (
        "compute from 605Ah, 6085h and 6084h how long a stop from 1500 r/min takes; write what is needed for "
        "it and read it back"
    )
    assert StopProof().plan(session) == (
        "turn at 150 r/min, command a quick stop, and time it, before anything turns faster"
    )
    cast(Any, session).limits = replace(LIMITS, travel_rad=10.0)
    assert _proof_speed(session) == pytest.approx(6.0), "0.3 of the travel within half a second"
