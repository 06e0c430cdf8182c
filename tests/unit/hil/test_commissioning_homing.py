"""Homing on the index pulse by a drive that does as scripted, and a turn by hand."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, Status
from servobench.drivers.errors import PeerFault
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.commissioning import turn
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.turn import _jump, _ramp, _search, can_home, hand_turn, index_turn
from servobench.hil.machine.stopping import Interrupted
from tests.unit.hil.scripted_drive import ENABLED
from tests.unit.hil.simulated_shaft import (
    PERIOD,
    VELOCITY_RAD_S,
    Objects,
    Shaft,
    session_of,
    shaft_of,
)

FOUND, FAILED, REACHED = Status.MODE_12, Status.MODE_13, Status.TARGET_REACHED
HOMED = ENABLED | FOUND | REACHED
JUMP: Final = 6.25
SPEED: Final = 3.0
"""rad/s."""
BEGIN: Final = Instant(5 * NS_PER_MS)


def reading(at_ms: float, position: float, word: int = ENABLED, stamp_ns: int | None = None) -> Reading:
    at = Instant(round(at_ms * NS_PER_MS))
    return Reading(0.0, stamp_ns, at, position, at, 0.0, at, word, at)


# ---- a jump of the position ------------------------------------------------------------------------------


def motion(count: int = 12, speed: float = SPEED) -> list[Reading]:
    """At a constant speed, until just before 0 ms."""
    return [reading(k - count, speed * (k - count) * 1e-3) for k in range(count)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("speed", [SPEED, -SPEED, 0.0])
def test_a_position_that_is_set_back_jumps_by_what_the_motion_leads_to_expect(
    sign: float, speed: float
) -> None:
    history = motion(speed=speed)
    assert _jump(history, reading(0.0, -sign * JUMP)) == pytest.approx(sign * JUMP)
    assert history == [], "the motion before it leads to nothing more"


def test_a_position_that_is_expected_within_a_hundredth_of_a_turn_is_no_jump() -> None:
    """Also one that is seen some cycles later."""
    for at_ms in (0.0, 4.0):
        expected = SPEED * at_ms * 1e-3
        for sign in (1.0, -1.0):
            history = motion()
            assert _jump(history, reading(at_ms, expected - sign * 0.0099 * math.tau)) == 0.0
            assert history == motion()
            beyond = _jump(history, reading(at_ms, expected - sign * 0.0101 * math.tau))
            assert beyond == pytest.approx(sign * 0.0101 * math.tau)


def test_the_motion_of_fewer_than_12_readings_leads_to_nothing() -> None:
    assert _jump(motion(11), reading(0.0, 100.0)) == 0.0
    assert _jump([], reading(0.0, 100.0)) == 0.0


def test_the_drives_stamps_tell_the_motion_where_readings_are_late() -> None:
    """All received at once, and sampled a millisecond apart."""
    history = [reading(50.0, SPEED * k * 1e-3, stamp_ns=(k + 7) * NS_PER_MS) for k in range(12)]
    assert _jump(history, reading(50.0, SPEED * 13e-3, stamp_ns=20 * NS_PER_MS)) == 0.0
    expected = pytest.approx(JUMP)
    assert _jump(history, reading(50.0, SPEED * 13e-3 - JUMP, stamp_ns=20 * NS_PER_MS)) == expected


def test_readings_without_time_between_them_tell_no_speed() -> None:
    history = [reading(1.0, 0.1 * k) for k in range(12)]
    assert _jump(history, reading(101.0, 1.1)) == 0.0


# ---- one homing ------------------------------------------------------------------------------------------


@dataclass
class Homing:
    """Each SYNC is answered by ``script``, which is given the number of the SYNC, from 1."""

    script: Callable[[int], tuple[float, int] | None]
    now: Instant = BEGIN
    syncs: int = 0
    bits: list[tuple[int, int]] = field(default_factory=list)
    stop_at: int = 10**9
    taken: int = 0

    def search(self, limit_s: float = 1.0) -> turn._Homing | None:
        """One."""
        clock = SimpleNamespace(now=lambda: self.now)
        network = SimpleNamespace(clock=clock, pump=self._pump, send_sync=self._sync)
        control = SimpleNamespace(set_bits=lambda mask, value: self.bits.append((mask, value)))
        here = self

        class Under(SimpleNamespace):
            @property
            def clock_now(self) -> Instant:
                return here.now

        session = Under(
            network=network,
            drive=SimpleNamespace(control=control, take_readings=self._readings),
            found=SimpleNamespace(period=PERIOD),
            wait=lambda seconds: self._pump(Instant(self.now + round(seconds * NS_PER_S))),
            deadline=lambda seconds: Instant(self.now + round(seconds * NS_PER_S)),
            check_stop=self._check_stop,
        )
        return _search(cast(Session, session), limit_s)

    def _pump(self, until: Instant) -> None:
        self.now = until

    def _sync(self) -> None:
        self.syncs += 1

    def _readings(self) -> list[Reading]:
        if self.syncs == self.taken:
            return []
        self.taken = self.syncs
        answer = self.script(self.syncs)
        return [] if answer is None else [reading(self.now / NS_PER_MS, *answer)]

    def _check_stop(self) -> None:
        if self.syncs >= self.stop_at:
            raise Interrupted("ended by SIGINT")


def homing(told_early: int = 0, pulse: int = 60, rest: int = 90) -> Callable[[int], tuple[float, int] | None]:
    """At a constant speed past the pulse, at rest from ``rest`` on; the statusword may be early."""

    def script(cycle: int) -> tuple[float, int]:
        position = 1.0 + SPEED * 1e-3 * min(cycle, rest) - (JUMP if cycle >= pulse else 0.0)
        found = FOUND if cycle >= pulse - told_early else 0
        return position, ENABLED | found | (REACHED if cycle >= rest else 0)

    return script


@pytest.mark.parametrize("told_early", [0, 1, 5])
def test_a_homing_tells_the_jump_and_how_far_the_shaft_ran_on(told_early: int) -> None:
    """Of a pulse that the statusword tells before the position is set back, too."""
    drive = Homing(homing(told_early))
    homed = drive.search()
    assert homed is not None
    assert homed.jump == pytest.approx(JUMP)
    assert homed.overshoot == pytest.approx(SPEED * 1e-3 * (30 + told_early))
    assert drive.syncs == 89 + 37, "36 readings that tell the end, and one more"
    assert drive.bits == [(16, 0), (16, 16), (16, 0)]
    assert drive.now == Instant((10 + 126) * NS_PER_MS), "5 ms for the bit to fall"


@pytest.mark.parametrize("word", [ENABLED | FOUND, ENABLED | REACHED, ENABLED])
def test_a_homing_that_does_not_end_in_time_is_given_up(word: int) -> None:
    drive = Homing(lambda _cycle: (0.0, word))
    assert drive.search(0.3) is None
    assert drive.syncs == 300
    assert drive.bits[-1] == (16, 0)


@pytest.mark.parametrize("word", [HOMED | FAILED, 0x0207 | FOUND | REACHED, 0x0208])
def test_a_homing_that_fails_or_a_drive_that_falls_out_ends_it_at_once(word: int) -> None:
    drive = Homing(lambda cycle: (0.0, word if cycle >= 30 else ENABLED))
    assert drive.search() is None
    assert drive.syncs == 30
    assert drive.bits[-1] == (16, 0)


def test_a_stop_that_is_asked_for_ends_it_with_the_bit_taken_back() -> None:
    drive = Homing(homing(), stop_at=7)
    with pytest.raises(Interrupted):
        drive.search()
    assert (drive.syncs, drive.bits[-1]) == (7, (16, 0))


# ---- the searches ----------------------------------------------------------------------------------------


class Searching:
    """A drive with homing; each series of searches gives the next of ``turns``: rad, none, or raises."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, *turns: float | Exception | None, **more: Any
    ) -> None:
        names = (Object.HOMING_METHOD, Object.HOMING_ACCELERATION, Object.SUPPORTED_DRIVE_MODES)
        self.objects = Objects(dict.fromkeys(((index, 0) for index in names), 0))
        self.objects.held |= {(Object.HOMING_SPEEDS, 1): 0, (Object.HOMING_SPEEDS, 2): 0}
        self.done: list[Any] = []
        left = iter(turns)

        def by_searches(_session: Session) -> float | None:
            each = next(left)
            if isinstance(each, Exception):
                raise each
            return each

        @contextmanager
        def armed() -> Iterator[None]:
            self.done.append("armed")
            yield
            self.done.append("safe")

        monkeypatch.setattr(turn, "_by_searches", by_searches)
        self.session = session_of(
            Shaft(shaft_of(1e-3), self.objects),
            drive=SimpleNamespace(
                change_mode=lambda mode, until: self.done.append((mode, until)),
                enable=lambda until: self.done.append(until),
            ),
            stop=SimpleNamespace(armed=armed),
            deadline=lambda seconds: seconds,
            calm=lambda: self.done.append("calm"),
            **more,
        )


ONE = ["armed", (Mode.HOMING, 1.0), 3.0, "calm", "safe"]


def written(turns_s: float) -> list[tuple[int, int, str, int]]:
    """The method, both speeds, and the ramp to them in a quarter of a second, in 1/6000 turn."""
    speed, ramp = round(6000 * turns_s), round(24000 * turns_s)
    return [
        (Object.HOMING_METHOD, 0, "b", 34),
        (Object.HOMING_SPEEDS, 1, "I", speed),
        (Object.HOMING_SPEEDS, 2, "I", speed),
        (Object.HOMING_ACCELERATION, 0, "I", ramp),
    ]


def test_no_pulse_at_any_speed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    searching = Searching(monkeypatch, None, None, None)
    assert index_turn(searching.session) == (None, "no index pulse came")
    assert searching.done == ONE * 3


def test_a_drive_that_fails_meanwhile_is_brought_to_rest_and_its_word_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searching = Searching(monkeypatch, None, PeerFault("it turns no more", "8611h"))
    assert index_turn(searching.session) == (None, str(PeerFault("it turns no more", "8611h")))
    assert searching.done == ONE * 2


def test_a_stop_that_is_asked_for_passes_with_the_drive_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    searching = Searching(monkeypatch, Interrupted("ended by SIGTERM"))
    with pytest.raises(Interrupted):
        index_turn(searching.session)
    assert searching.done[-1] == "calm"


def test_settings_that_the_drive_does_not_take_leave_it_unmoved(monkeypatch: pytest.MonkeyPatch) -> None:
    searching = Searching(monkeypatch)
    del searching.objects.held[Object.HOMING_SPEEDS, 2]
    searching.objects.stubborn = {Object.HOMING_METHOD, Object.HOMING_ACCELERATION}
    assert index_turn(searching.session) == (
        None,
        "homing on the index: 6098h holds 0, 34 was asked for; "
        "6099h:02 is missing: homing speed left to the drive; "
        "homing acceleration: 609Ah holds 0, 12000 was asked for",
    )
    assert searching.done == []


@pytest.mark.parametrize(
    ("unit", "raw"),
    [(VELOCITY_RAD_S, 12000), (100.0, 1), (math.tau / 3.0, 6), (1e-12, 0xFFFF_FFFF)],
)
def test_the_ramp_is_a_whole_number_of_32_bits(
    monkeypatch: pytest.MonkeyPatch, unit: float, raw: int
) -> None:
    searching = Searching(monkeypatch, acceleration_rad_s2=unit)
    assert _ramp(searching.session, 0.5) == []
    assert searching.objects.written == [(Object.HOMING_ACCELERATION, 0, "I", raw)]


def test_a_drive_without_a_ramp_of_homing_is_left_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    searching = Searching(monkeypatch)
    del searching.objects.held[Object.HOMING_ACCELERATION, 0]
    assert _ramp(searching.session, 0.5) == []
    assert searching.objects.written == []


@pytest.mark.parametrize(
    ("method", "modes", "able"),
    [
        (0, None, True),
        (0, 0, True),
        (0, 1 << 5, True),
        (0, 0xFFDF, False),
        (None, 1 << 5, False),
    ],
)
def test_homing_is_told_by_6098h_and_6502h(method: int | None, modes: int | None, able: bool) -> None:
    held = {(Object.HOMING_METHOD, 0): method, (Object.SUPPORTED_DRIVE_MODES, 0): modes}
    objects = Objects({key: value for key, value in held.items() if value is not None})
    session = session_of(Shaft(shaft_of(1e-3), objects))
    assert can_home(session) is able
    if not able:
        assert index_turn(session) == (None, "the drive has no homing")


@pytest.mark.parametrize(
    ("after", "reply", "units"),
    [(4096, "", 4096.0), (-4096, "", 4096.0), (4096, "s", None), (4096, "Skip", None), (0, "", None)],
)
def test_a_turn_by_hand_is_what_lies_between_two_positions(
    after: int, reply: str, units: float | None
) -> None:
    objects = Objects({(Object.POSITION_ACTUAL_VALUE, 0): 100})
    asked = []

    def line(question: str, _idle: Any) -> str:
        asked.append(question)
        objects.held[Object.POSITION_ACTUAL_VALUE, 0] = 100 + after
        return reply

    session = session_of(Shaft(shaft_of(1e-3), objects), dialog=SimpleNamespace(line=line), idle=lambda: None)
    why = "the shaft was not turned by hand" if units is None else "by hand"
    assert hand_turn(session) == (units, why)
    assert asked == [
        "    Mark the shaft, turn it by hand by exactly one turn, and press Enter; s if it cannot."
    ]
