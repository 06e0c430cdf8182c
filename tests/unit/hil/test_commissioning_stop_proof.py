"""A slow stop is timed, and held against what its settings say."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.cia402.profile import QuickStopOption
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.commissioning import steps_stopping
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.identify import Array
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_stopping import (
    SlowStop,
    StopProof,
    _computed_s,
    _measured,
    _proof_speed,
    _stop_slowly,
    _until_rest,
)
from tests.unit.hil.simulated_shaft import POSITION_RAD
from tests.unit.hil.test_commissioning_stopping import PROFILE, QUICK, SPEED, UNIT, asked

ENABLED, STOPPING = 0x0627, 0x0607


@pytest.mark.parametrize(
    ("option", "computed_s"),
    [
        (QuickStopOption.QUICK_STOP_RAMP, 15.0 / (1000 * UNIT)),
        (QuickStopOption.SLOW_DOWN_RAMP, 15.0 / (500 * UNIT)),
        (QuickStopOption.CURRENT_LIMIT, None),
    ],
)
def test_a_stop_is_computed_by_its_ramp(option: QuickStopOption, computed_s: float | None) -> None:
    session, objects = asked({QUICK: 1000, PROFILE: 500})
    session.found.quick_stop_option = option
    assert _computed_s(session, 15.0) == (None if computed_s is None else pytest.approx(computed_s))
    objects.held.clear()
    assert _computed_s(session, 15.0) is None


def proof(
    monkeypatch: pytest.MonkeyPatch, session: Session, *stops: SlowStop
) -> tuple[StepOutcome, StepFailed | None]:
    """The step with these stops for measured ones, and its failure."""
    left = iter(stops)
    monkeypatch.setattr(steps_stopping, "_stop_slowly", lambda _session: next(left))
    outcome = StepOutcome()
    try:
        StopProof().run(session, outcome)
    except StepFailed as failure:
        return outcome, failure
    assert not list(left), "a stop that was not asked for"
    return outcome, None


def test_a_stop_as_computed_is_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """15 rad/s in 0.1 s; readings and controller may take 27 ms beside one and a half times that."""
    session, _ = asked({QUICK: round(150.0 / UNIT)})
    computed_s = 15.0 / (round(150.0 / UNIT) * UNIT)
    for time_s in (0.1, 0.027 + 1.4999 * computed_s):
        outcome, failure = proof(monkeypatch, session, SlowStop(15.0, time_s))
        assert failure is None
        at_limit_s = SPEED * time_s / 15.0
        assert outcome.lines == [
            f"from 15 rad/s to rest in {1e3 * time_s:.0f} ms, 100 ms were computed; "
            f"so {at_limit_s:.2f} s from the limit of speed"
        ]
        assert outcome.figures == {
            "speed_rad_s": 15.0,
            "stop_s": time_s,
            "computed_s": pytest.approx(computed_s),
            "stop_at_limit_s": pytest.approx(at_limit_s),
        }
        assert outcome.faults == []


def test_a_slower_stop_tells_the_unit_of_6085h_and_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = round(150.0 / UNIT)
    session, _ = asked({QUICK: raw})
    slow = SlowStop(15.0, 0.027 + 1.5001 * 15.0 / (raw * UNIT))
    outcome, failure = proof(monkeypatch, session, slow, SlowStop(15.0, 0.05))
    unit = 15.0 / slow.time_s / raw
    assert failure is None
    assert outcome.faults == [
        f"acceleration unit: one unit of 6085h is {unit:.3g} rad/s^2 by a measured stop, "
        f"{UNIT:.3g} as the drive tells"
    ]
    assert session.found.override.acceleration_rad_s2 == pytest.approx(unit)
    assert session.found.quick_stop_rad_s2 == pytest.approx(SPEED / 0.5)
    assert len(cast(Any, session).configured) == 1
    assert len(outcome.lines) == 2


@pytest.mark.parametrize(("gentle_s", "believed"), [(0.05, False), (0.3, True)])
def test_a_steep_ramp_is_tried_gentler_before_its_unit_is_doubted(
    monkeypatch: pytest.MonkeyPatch, gentle_s: float, believed: bool
) -> None:
    """15 rad/s by 6000 rad/s^2, 2.5 ms, is more than a motor may have; by 314 rad/s^2, 48 ms, it is not."""
    raw = round(6000.0 / UNIT)
    session, objects = asked({QUICK: raw})
    stops = [SlowStop(15.0, 0.06), SlowStop(15.0, gentle_s), *[SlowStop(15.0, 0.05)] * believed]
    configured: list[float | None] = []

    def configure() -> None:
        rate = session.found.quick_stop_rad_s2
        configured.append(rate)
        objects.held[QUICK] = round((rate or 0.0) / UNIT)

    cast(Any, session).configure = configure
    outcome, failure = proof(monkeypatch, session, *stops)
    assert failure is None
    gentle = SPEED / 0.5
    assert configured == [gentle, pytest.approx(gentle if believed else raw * UNIT)]
    assert session.found.quick_stop_rad_s2 == (gentle if believed else None), "its own ramp is set again"
    unit = f"one unit of 6085h is {15.0 / 0.06 / raw:.3g} rad/s^2"
    assert [unit in fault for fault in outcome.faults] == [True] * believed


def test_a_stop_that_is_slow_twice_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    session, _ = asked({QUICK: round(150.0 / UNIT)})
    outcome, failure = proof(monkeypatch, session, SlowStop(15.0, 0.3), SlowStop(15.0, 0.3))
    assert failure is not None
    assert (failure.summary, failure.evidence, failure.remedy) == (
        "the drive does not stop as it should",
        outcome.lines[-1],
        "set 6085h with the maker's tool; nothing was turned faster than this",
    )
    assert len(outcome.faults) == 1


@pytest.mark.parametrize(("at_limit_s", "proven"), [(2.2699, True), (2.2701, False)])
def test_a_stop_that_is_not_computed_takes_two_seconds_from_the_limit(
    monkeypatch: pytest.MonkeyPatch, at_limit_s: float, proven: bool
) -> None:
    session, _ = asked({})
    stop = SlowStop(15.0, at_limit_s * 15.0 / SPEED)
    outcome, failure = proof(monkeypatch, session, *[stop] * (1 if proven else 2))
    assert (failure is None) is proven
    assert outcome.lines[0].split(", ")[1].startswith("not computed; so 2.27 s")
    assert outcome.faults == [], "there is no unit to blame"


# ---- the stop that is measured ---------------------------------------------------------------------------


def reading(at_ms: float, position_rad: float, statusword: int = STOPPING) -> Reading:
    at = Instant(round(at_ms * NS_PER_MS))
    return Reading(0.0, None, at, position_rad, at, 0.0, at, statusword, at)


def braked(stop_ms: int, count: int, speed: float = 10.0) -> list[Reading]:
    """Evenly braked to rest within ``stop_ms``, a reading each ms, the first three still enabled."""
    readings = [reading(at_ms, 1e-3 * speed * (at_ms - 3), ENABLED) for at_ms in range(3)]
    for at_ms in range(count):
        passed = min(at_ms, stop_ms)
        path = speed * 1e-3 * (passed - passed**2 / (2.0 * stop_ms))
        readings.append(reading(at_ms + 3, path))
    return readings


def test_a_stop_is_timed_from_its_statusword_until_the_last_motion() -> None:
    """Two units of position are rest; 10 rad/s within 100 ms are so near 4 ms before the end."""
    session, _ = asked({})
    near_ms = math.sqrt(2.0 * 2.0 * POSITION_RAD * 100.0 / 10.0 * 1e3)
    found = _measured(session, 10.0, braked(100, 120))
    assert found.speed_rad_s == 10.0
    assert found.time_s == pytest.approx(1e-3 * (math.floor(100.0 - near_ms) + 1))
    assert found.deceleration_rad_s2 == pytest.approx(10.0 / found.time_s)


def test_a_stop_within_a_reading_takes_a_period() -> None:
    session, _ = asked({})
    assert _measured(session, 3.0, [reading(at_ms, 1.0) for at_ms in range(6)]) == SlowStop(3.0, 1e-3)


def test_a_shaft_that_still_turns_is_expected_to_stop_by_its_deceleration() -> None:
    """From the speed lost between the beginning and the middle of the second half."""
    session, _ = asked({})
    found = _measured(session, 10.0, braked(400, 201))
    assert found.time_s == pytest.approx(0.4, rel=0.01)


def test_a_shaft_that_does_not_slow_down_never_stops() -> None:
    session, _ = asked({})
    readings = [reading(at_ms, 0.01 * at_ms) for at_ms in range(101)]
    assert _measured(session, 10.0, readings).time_s == pytest.approx(0.75 * 0.1 * 1000.0)


@pytest.mark.parametrize("stopping", [0, 1])
def test_a_statusword_that_stays_enabled_is_no_stop(stopping: int) -> None:
    session, _ = asked({})
    readings = [reading(at_ms, 1.0, ENABLED) for at_ms in range(10)]
    readings += [reading(10, 1.0)] * stopping
    with pytest.raises(StepFailed) as caught:
        _measured(session, 10.0, readings)
    assert (caught.value.summary, caught.value.evidence) == (
        "the drive does not follow a quick stop",
        "its statusword says that it is enabled",
    )


class Stopping(SimpleNamespace):
    """A session that waits for rest, whose readings are a function of the cycles since."""

    def __init__(self, reading_of: Callable[[int], Reading]) -> None:
        super().__init__(**vars(asked({})[0]))
        self.reading_of = reading_of
        self.notes: list[str] = []
        self.cycle = 0
        self.network = self.dialog = self
        self.drive = self

    @property
    def clock_now(self) -> Instant:
        return Instant(self.cycle * NS_PER_MS)

    def deadline(self, seconds: float) -> Instant:
        return Instant(self.clock_now + round(seconds * NS_PER_S))

    def check_stop(self) -> None:
        pass

    def send_sync(self) -> None:
        self.cycle += 1

    def pump(self, until: Instant) -> None:
        assert until == self.clock_now + NS_PER_MS

    def take_readings(self) -> list[Reading]:
        return [self.reading_of(self.cycle)] if self.cycle else []

    def stop(self) -> None:
        self.notes.append("stop")

    def let_go(self) -> None:
        self.notes.append("let go")

    def tell(self, text: str) -> None:
        self.notes.append(text)


@pytest.mark.parametrize(("flicker", "cycles"), [(0, 9), (2, 9), (3, 2000)])
def test_a_shaft_rests_when_five_readings_lie_within_two_units(flicker: int, cycles: int) -> None:
    """It moves until the fourth."""

    def reading_of(cycle: int) -> Reading:
        moving = 1.0 if cycle <= 4 else 0.0
        return reading(cycle, moving * cycle + POSITION_RAD * (flicker if cycle % 2 else 0))

    session = Stopping(reading_of)
    readings = _until_rest(cast(Session, session))
    assert (len(readings), session.cycle) == (cycles, cycles)
    told = ["    the quick stop takes too long: the shaft is let go, and coasts", "let go"]
    assert session.notes == ["stop", *(told if cycles == 2000 else [])]


def test_an_enabled_drive_does_not_rest() -> None:
    session = Stopping(lambda cycle: reading(cycle, 1.0, ENABLED if cycle < 12 else STOPPING))
    assert len(_until_rest(cast(Session, session))) == 12


@pytest.mark.parametrize(
    ("count", "part", "fails"),
    [
        (10, 1.0, None),
        (9, 1.0, ("too few readings came", "")),
        (20, 0.31, None),
        (20, -0.31, None),
        (20, 0.29, ("the shaft does not reach a low speed", "4.56 of 15.7 rad/s in 0.5 s")),
    ],
)
def test_the_speed_before_a_stop_is_that_of_the_last_ten_readings(
    monkeypatch: pytest.MonkeyPatch, count: int, part: float, fails: tuple[str, str] | None
) -> None:
    time: Array = np.linspace(0.0, 1e-3 * (count - 1), count)
    speed = part * _proof_speed(asked({})[0])
    nothing = np.zeros(count)
    before = Recording(time, speed * time, nothing, nothing, nothing, count, 0, ())
    monkeypatch.setattr(steps_stopping, "follow", lambda *_: before)
    session = cast(Session, Stopping(lambda cycle: reading(cycle, 1.0)))
    if fails is None:
        found = _stop_slowly(session)
        assert [found.speed_rad_s, found.time_s] == pytest.approx([abs(speed), 1e-3])
        return
    with pytest.raises(StepFailed) as caught:
        _stop_slowly(session)
    assert (caught.value.summary, caught.value.evidence) == fails
