"""The step that holds torque against current, on a shaft that is known, and all that it says."""

import math
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
import pytest

from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.told_motor import ToldFigure, ToldMotor
from servobench.drivers.errors import TransferAborted
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import ReadingsLost, StatedFigure, StepFailed, StepOutcome
from servobench.hil.commissioning.identify import Array, slope_error
from servobench.hil.commissioning.request import Nameplate
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_current import TorqueConstant, _paired, _plan_with_current, _swing
from servobench.hil.loop.scenario import Quantity
from tests.unit.hil.simulated_shaft import LIMITS, PERIOD_S, RATED_NM, Shaft, session_of, shaft_of

TRUTH = shaft_of(2e-3, 2e-3, 0.05)
NM_A: Final = 0.5
RATED_A: Final = 4.0
CURRENT_FRAME: Final = 0x185
"""TPDO1 of node 5."""


class Metered(Shaft):
    """A shaft whose drive tells torque and current of each sample in one frame."""

    line: Any
    tapped: Callable[..., None]

    def run(self, controller: Any, duration: float, *more: Any, **options: Any) -> Recording:
        recording = super().run(controller, duration, *more, **options)
        for number, torque_nm in enumerate(recording.torque):
            at = Instant(round((number + 1) * 1e9 * PERIOD_S))
            raw = round(1e3 * torque_nm / NM_A / RATED_A)
            data = raw.to_bytes(2, "little", signed=True) + b"\x7f" * 6
            self.tapped("rx", CURRENT_FRAME, data, False, False, at)
            self.tapped("rx", CURRENT_FRAME + 0x100, b"\x11" * 8, False, False, at)
            self.line.listener([Reading(0.0, None, at, 0.0, at, float(torque_nm), at, 0, at)])
        return recording


def commissioned(
    shaft: Shaft | None = None, *, rated_ma: int | None = 4000, refuses: Exception | None = None, **plate: Any
) -> Session:
    """A session on a shaft of 0.5 N m/A; ``asked`` are the modes and plans that it was configured with."""
    made = shaft or Metered(TRUTH)
    if rated_ma is not None:
        made.objects.held[Object.MOTOR_RATED_CURRENT, 0] = rated_ma
    made.objects.held[Object.CURRENT_ACTUAL_VALUE, 0] = 0
    asked: list[tuple[Mode | None, PdoPlan | None]] = []

    def configure(mode: Mode | None = None, plan: PdoPlan | None = None) -> None:
        asked.append((mode, plan))
        if plan is not None and refuses is not None:
            raise refuses

    port = SimpleNamespace(listener=None)
    cast(Any, made).line = port
    link = SimpleNamespace(tap=lambda take: setattr(made, "tapped", take))
    request = SimpleNamespace(nameplate=Nameplate.model_validate(plate), node=5, bitrate_bit_s=1_000_000)
    session = session_of(
        made,
        request=request,
        network=SimpleNamespace(link=link),
        configure=configure,
        asked=asked,
        port=port,
    )
    session.found.mechanics = TRUTH
    return session


# ---- whether, and how ------------------------------------------------------------------------------------


def test_it_needs_a_torque_mode_and_both_readings() -> None:
    step = TorqueConstant()
    assert step.left_out(commissioned()) is None
    speeds = commissioned(Shaft(TRUTH, quantity=Quantity.SPEED))
    assert step.left_out(speeds) == "the drive has no torque mode"
    silent = commissioned()
    only_current = SimpleNamespace(tpdo_with=lambda _index: None)
    silent.found.plan = cast(Any, only_current)
    assert step.left_out(silent) == "the drive tells no torque 6077h"
    without = commissioned()
    cast(Any, without.objects).held.pop((Object.CURRENT_ACTUAL_VALUE, 0))
    assert step.left_out(without) == "the drive has no current actual value 6078h"


def test_its_plan_tells_six_tenths_of_the_torque_limit() -> None:
    told = f"map 6078h beside 6077h and swing the shaft with {0.6 * LIMITS.torque_nm:.4g} N m"
    assert TorqueConstant().plan(commissioned()) == told


def test_the_constant_of_a_shaft_is_found_and_the_drive_is_as_before() -> None:
    session, outcome = commissioned(), StepOutcome()
    TorqueConstant().run(session, outcome)
    assert session.found.torque_constant_nm_a == pytest.approx(NM_A, rel=2e-4)
    assert outcome.figures["straightness"] == pytest.approx(1.0, abs=1e-5)
    assert outcome.faults == []
    mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    (first, plan), last = cast(Any, session).asked
    assert (first, last) == (mode, (mode, None))
    assert plan == _plan_with_current(session)
    assert cast(Any, session).pictures == ["torque_constant"]


@pytest.mark.parametrize(
    "refusal", [TransferAborted("0604 0041h", "1A00h:01", ""), SettingRefused("1A00h:01 holds 0")]
)
def test_a_current_that_cannot_be_mapped_fails_it_and_the_drive_is_set_up_as_before(
    refusal: Exception,
) -> None:
    session = commissioned(refuses=refusal)
    with pytest.raises(StepFailed) as caught:
        TorqueConstant().run(session, StepOutcome())
    assert caught.value.summary == "6078h cannot be mapped beside the rest"
    assert caught.value.evidence == str(refusal)
    assert [plan is None for _, plan in cast(Any, session).asked] == [False, True]


def test_after_a_swing_that_failed_the_drive_is_set_up_as_before() -> None:
    session = commissioned(Metered(TRUTH, lost=10**6))
    with pytest.raises(ReadingsLost):
        TorqueConstant().run(session, StepOutcome())
    assert cast(Any, session).asked[-1] == (Mode.CYCLIC_SYNCHRONOUS_TORQUE, None)


@pytest.mark.parametrize("stamped", [False, True])
def test_the_current_takes_the_place_of_the_statusword(stamped: bool) -> None:
    session = commissioned()
    if stamped:
        cast(Any, session.objects).held[Cia301.HIGH_RESOLUTION_TIME_STAMP, 0] = 7
    plan = _plan_with_current(session)
    told = [
        (pdo.number, pdo.cob_id, pdo.transmission_type, [(entry.index, entry.code) for entry in pdo.entries])
        for pdo in plan.tpdos
    ]
    stamp = [(Cia301.HIGH_RESOLUTION_TIME_STAMP, "I")] * stamped
    first = [
        (Object.CURRENT_ACTUAL_VALUE, "h"),
        (Object.TORQUE_ACTUAL_VALUE, "h"),
        (Object.POSITION_ACTUAL_VALUE, "i"),
    ]
    assert told == [
        (1, 0x185, 1, first),
        (2, 0x285, 1, [(Object.VELOCITY_ACTUAL_VALUE, "i"), *stamp]),
        (3, 0x385, 1, [(Object.STATUSWORD, "H")]),
    ]
    (command,) = plan.rpdos
    assert [entry.index for entry in command.entries] == [Object.CONTROLWORD, Object.TARGET_TORQUE]


def test_a_bus_without_room_for_the_current_is_not_filled() -> None:
    """At 1 Mbit/s the frames take most of 1 ms; a bound of nine tenths of the bus."""
    session = commissioned()
    shortest = next(us for us in range(200, 2000) if not refuses_plan(session, Duration(us * NS_PER_US)))
    session.found.period = Duration((shortest - 1) * NS_PER_US)
    with pytest.raises(StepFailed) as caught:
        _plan_with_current(session)
    assert (caught.value.summary, caught.value.evidence) == (
        "the bus has no room for the current",
        "90 % load",
    )


def refuses_plan(session: Session, period: Duration) -> bool:
    session.found.period = period
    try:
        _plan_with_current(session)
    except StepFailed:
        return True
    return False


# ---- the swing -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inertia", "omega"),
    [
        (0.1, math.tau * 2.0),
        (2e-4, 0.6 * LIMITS.torque_nm / (2e-4 * 0.4 * LIMITS.speed_rad_s)),
    ],
)
def test_a_swing_of_2_hz_or_as_quick_as_four_tenths_of_the_speed_need(inertia: float, omega: float) -> None:
    """By a cosine that begins within a tenth of a second."""
    shaft = Metered(TRUTH, quantity=Quantity.TORQUE)
    session = commissioned(shaft)
    session.found.mechanics = shaft_of(inertia)
    cast(Any, session).network.link.tap(lambda *_told: None)
    readings = _swing(session)
    time = PERIOD_S * np.arange(len(readings))
    asked = 0.6 * LIMITS.torque_nm * np.cos(omega * time) * np.minimum(1.0, time / 0.1)
    told = np.array([torque_nm for _, torque_nm in readings])
    assert len(told) == 1499
    assert np.allclose(told[1:], asked[:-1], rtol=0.0, atol=1e-12), "what acted until each sample"
    assert [at for at, _ in readings[:2]] == [Instant(NS_PER_MS), Instant(2 * NS_PER_MS)]


def pairs(count: int) -> tuple[list[tuple[Instant, float]], list[tuple[Instant, int]]]:
    readings = [(Instant(10 * k), 0.5 * k) for k in range(count + 2)]
    currents = [(Instant(10 * k), -k) for k in range(1, count + 1)]
    return readings, [(Instant(3), 99), *currents]


def test_torque_and_current_are_of_the_same_frame() -> None:
    torque, current = _paired(*pairs(50))
    assert torque.tolist() == [0.5 * k for k in range(1, 51)]
    assert current.tolist() == [-k for k in range(1, 51)]
    with pytest.raises(StepFailed) as caught:
        _paired(*pairs(49))
    assert (caught.value.summary, caught.value.evidence) == (
        "torque and current could not be paired",
        "49 pairs",
    )


# ---- what is said ----------------------------------------------------------------------------------------

SWING: Array = np.array([-250.0, -150.0, -50.0, 50.0, 150.0, 250.0] * 20)
"""Thousandths of 4 A."""
AMPERES = RATED_A / 1e3 * SWING
AWRY: Array = np.array([4.0, -2.0, -2.0, -2.0, -2.0, 4.0] * 20) / 3.0
"""Even in the current: no slope of its own."""


def judged(torque: Array, permille: Array = SWING, session: Session | None = None) -> StepOutcome:
    outcome = StepOutcome()
    TorqueConstant()._judge(session or commissioned(), torque, permille, outcome)
    return outcome


def test_all_that_is_said_of_a_torque_constant() -> None:
    """The step of a torque's thousandth is uniform: 1/sqrt(12) of it, over the scatter of the current."""
    session = commissioned()
    torque = 0.45 * AMPERES + 0.02 + 0.03 * AWRY
    outcome = judged(torque, session=session)
    scatter = 0.2 * RATED_A / 1e3 * math.sqrt(np.mean(np.array([1250.0, 750.0, 250.0]) ** 2))
    rounding = 1e-3 * RATED_NM / math.sqrt(12.0) / scatter
    error = 2.0 * math.hypot(rounding, slope_error(AMPERES, torque))
    straightness = 1.0 - np.var(0.03 * AWRY) / (0.45**2 * scatter**2 + np.var(0.03 * AWRY))
    assert session.found.torque_constant_nm_a == pytest.approx(0.45)
    assert outcome.figures == {
        "torque_constant_nm_a": pytest.approx(0.45),
        "torque_constant_error": pytest.approx(error),
        "coverage_factor": 2.0,
        "straightness": pytest.approx(straightness),
    }
    assert outcome.quantities == [
        StatedFigure(
            "torque constant, as the drive has it",
            cast(float, session.found.torque_constant_nm_a),
            "N m/A rms",
            outcome.figures["torque_constant_error"],
        )
    ]
    assert outcome.lines == [
        f"0.45 N m per A rms +- {error:.2g} (k = 2), straightness {straightness:.4f}, 120 pairs"
    ]
    assert outcome.faults == []
    assert cast(Any, session).pictures == ["torque_constant"]


def test_a_current_of_2_percent_of_its_rating_is_enough() -> None:
    for permille, enough in ((10.0, True), (9.99, False)):
        swing = permille * np.sign(SWING)
        session = commissioned(rated_ma=1000)
        if enough:
            assert judged(1e-3 * swing, swing, session).figures["torque_constant_nm_a"] == pytest.approx(1.0)
            continue
        with pytest.raises(StepFailed) as caught:
            judged(1e-3 * swing, swing, session)
        assert caught.value.summary == "the current 6078h does not follow the torque"
        assert caught.value.evidence == "0.02 A of swing"


def test_the_ampere_is_the_drives_rating_else_the_plates() -> None:
    assert judged(0.45 * AMPERES, session=commissioned(rating={"current_a": 8.0})).figures[
        "torque_constant_nm_a"
    ] == pytest.approx(0.45)
    for rated_ma in (None, 0):
        by_plate = commissioned(rated_ma=rated_ma, rating={"current_a": 8.0})
        assert judged(0.45 * AMPERES, session=by_plate).figures["torque_constant_nm_a"] == pytest.approx(
            0.225
        )
        with pytest.raises(StepFailed) as caught:
            judged(0.45 * AMPERES, session=commissioned(rated_ma=rated_ma))
        assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
            "no rated current",
            "6075h is missing or 0",
            "give rating.current_a in the nameplate",
        )


WRONG = "6075h, 6076h or the nameplate is wrong"


def contradictions() -> Iterator[tuple[float, list[str]]]:
    """What is measured, of a plate with 0.5 N m/A."""
    for alike in (0.451, 0.5, 0.549, -0.549):
        yield alike, []
    for nm_a, by, slip in (
        (0.449, "0.898", ""),
        (-0.449, "0.898", ""),
        (0.552, "1.104", ""),
        (0.75, "1.5", " (power-invariant and amplitude-invariant transforms mixed up)"),
        (0.77, "1.54", " (power-invariant and amplitude-invariant transforms mixed up)"),
        (0.774, "1.548", ""),
        (1.0, "2", " (a factor of two)"),
    ):
        yield nm_a, [f"torque and current contradict the nameplate by {by}: {WRONG}{slip}"]


@pytest.mark.parametrize(("nm_a", "faults"), list(contradictions()))
def test_a_plate_that_is_contradicted_by_more_than_a_tenth_is_a_fault(nm_a: float, faults: list[str]) -> None:
    session = commissioned(rating={"torque_nm": 2.0, "current_a": 4.0})
    outcome = judged(nm_a * AMPERES, session=session)
    signs = ["current 6078h and torque 6077h have opposite signs"] * (nm_a < 0.0)
    assert outcome.faults == signs + faults
    assert outcome.lines[1:] == ["the nameplate's ratings make 0.5 N m/A"]
    assert outcome.figures["nameplate_nm_a"] == 0.5


def test_the_constant_that_the_maker_tells_is_held_against_it() -> None:
    figure = ToldFigure("torque_constant_nm_a", 0.5, 500, "2000h:01", "x.toml", "rms")
    session = commissioned()
    session.found.motor = ToldMotor({"torque_constant_nm_a": figure})
    assert judged(-0.5 * AMPERES, session=session).figures["told_nm_a"] == 0.5
    assert len(judged(0.6 * AMPERES, session=session).faults) == 1
