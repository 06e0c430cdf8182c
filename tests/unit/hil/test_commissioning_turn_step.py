"""The step that measures a turn: what becomes of the units of position and velocity."""

from typing import Any, cast

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.identify import SpeedRatio
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_units import Turn, _unmeasured
from tests.unit.hil.simulated_shaft import (
    POSITION_RAD,
    VELOCITY_RAD_S,
    Answering,
    Shaft,
    request_of,
    session_of,
    shaft_of,
)
from tests.unit.hil.test_commissioning_units import TRUTH, run, times_configured


def turning(counts: int | None, attended: bool = False, trusted: bool = False, **more: Any) -> Session:
    """A session without homing; 65536 position units are a turn by the drive's objects."""
    request = request_of({"encoder": {"counts_per_revolution": counts}}, trust_nameplate=trusted)
    session = session_of(Shaft(TRUTH), request=request, dialog=Answering("" if attended else None), **more)
    session.found.velocity_ratio = SpeedRatio(1.0, 0.01)
    session.found.rough = shaft_of(2e-3)
    return session


def test_a_turn_that_is_as_the_drive_says_changes_nothing() -> None:
    session = turning(65536)
    outcome = run(Turn(), session)
    assert outcome.lines == [
        "one turn is 65536 position units (the nameplate's encoder, whose counts are taken for position "
        "units); the drive's objects say 65536"
    ]
    assert outcome.faults == []
    assert outcome.figures == {
        "units_per_turn": 65536.0,
        "told_units_per_turn": pytest.approx(65536.0),
        "position_rad": POSITION_RAD,
        "velocity_rad_s": VELOCITY_RAD_S,
    }
    assert session.found.override.position_rad == POSITION_RAD
    assert session.found.rough == shaft_of(2e-3)
    assert times_configured(session) == 2, "back from homing, and with the units"


def test_a_turn_of_four_times_the_units_puts_position_and_velocity_right() -> None:
    """The nameplate is trusted: by the quarter, counts instead of lines."""
    session = turning(4 * 65536, trusted=True)
    session.found.velocity_ratio = SpeedRatio(4.0, 0.01)
    outcome = run(Turn(), session)
    position = POSITION_RAD / 4.0
    assert session.found.override.position_rad == pytest.approx(position)
    assert outcome.figures["position_fault"] == 4.0
    assert outcome.faults[0].startswith(
        f"position unit: 608Fh makes {POSITION_RAD:.6g} rad of it, it is {position:.6g} rad; that is taken "
        "(a factor of 4: "
    )
    assert session.found.rough is not None
    assert session.found.rough.inertia_kg_m2 == pytest.approx(8e-3), "it was by the old unit"


@pytest.mark.parametrize(
    ("turn", "ratio", "position", "velocity"),
    [
        (1.0, 10.0, 1.0, 0.1),
        (4.0, 1.0, 0.25, 0.25),
        (4.0, 0.25, 0.25, 1.0),
        (1.0299, 1.0, 1.0, 1.0),
        (0.5, 2.0, 2.0, 1.0),
    ],
)
def test_the_velocity_unit_follows_from_the_position_unit(
    turn: float, ratio: float, position: float, velocity: float
) -> None:
    session, outcome = turning(65536), StepOutcome()
    session.found.velocity_ratio = SpeedRatio(ratio, 0.01)
    session.found.rough = None
    Turn()._judge(session, turn, outcome)
    expected = {"position_rad": position * POSITION_RAD, "velocity_rad_s": velocity * VELOCITY_RAD_S}
    override = session.found.override
    assert override.position_rad == pytest.approx(expected["position_rad"])
    assert override.velocity_rad_s == pytest.approx(expected["velocity_rad_s"], rel=0.02)
    assert [fault.split(":")[0] for fault in outcome.faults] == [
        *["position unit"] * (position != 1.0),
        *["velocity unit"] * (velocity != 1.0),
    ]
    assert ("velocity_fault" in outcome.figures) is (velocity != 1.0)
    assert session.found.rough is None


def test_a_turn_that_nobody_can_measure_fails_without_the_nameplates_encoder() -> None:
    with pytest.raises(StepFailed) as caught:
        run(Turn(), turning(None))
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "no turn could be measured",
        "the drive has no homing",
        "give encoder.counts_per_revolution in the nameplate",
    )


def test_a_nameplate_that_is_not_believed_is_a_fault() -> None:
    session, outcome = turning(4000, attended=True), StepOutcome()
    cast(Any, session).dialog.line = lambda _question, _idle: "d"
    found = _unmeasured(session, 4000, 1000.0, outcome)
    assert found == (1000.0, "not measured; the drive's objects are believed")
    assert outcome.faults == [
        "nameplate: 4000 counts per turn are not believed, the drive's objects say 1000 position units"
    ]


@pytest.mark.parametrize(
    ("counts", "attended", "reason"),
    [
        (65536, False, None),
        (None, True, None),
        (
            None,
            False,
            "no homing, nobody there to turn the shaft, and no nameplate that tells the encoder",
        ),
    ],
)
def test_a_turn_needs_homing_or_somebody_or_a_nameplate(
    counts: int | None, attended: bool, reason: str | None
) -> None:
    assert Turn().left_out(turning(counts, attended)) == reason
    homing = turning(counts, attended)
    homing.objects.held[Object.HOMING_METHOD, 0] = 34  # type: ignore[attr-defined]
    assert Turn().left_out(homing) is None
