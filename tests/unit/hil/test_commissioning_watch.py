"""The proof of a drive's watch over its host, and what becomes of a drive without one."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import PeerFault
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_setup import Watchdog
from servobench.hil.machine.stopping import Interrupted
from tests.unit.hil.scripted_drive import DISABLED, ENABLED, FAULT
from tests.unit.hil.simulated_shaft import LIMITS, PERIOD, Shaft, session_of, shaft_of

TRUTH = shaft_of(1e-3)
TIMEOUT_MS: Final = 150


@dataclass
class Watched:
    """A drive whose host falls silent: from then on ``word`` and ``state`` are what it tells, by ms."""

    word: Callable[[float], int | None]
    """Of each reading; None: there is none."""
    state: Callable[[float], State | None] = lambda _ms: State.OPERATION_ENABLED
    """As it is asked for."""
    emergency_ms: float = math.inf
    now: Instant = field(default_factory=lambda: Instant(7 * NS_PER_MS))
    silent_at: Instant | None = None
    notes: list[str] = field(default_factory=list)
    asked_ms: list[float] = field(default_factory=list)
    stop_ms: float = math.inf
    failing: PeerFault | None = None
    _synced: bool = False
    emergencies: list[Any] = field(default_factory=list)

    @property
    def emergencies_seen(self) -> int:
        if self.ms >= self.emergency_ms and not self.emergencies:
            assert self.silent_at is not None
            at = Instant(self.silent_at + round(self.emergency_ms * NS_PER_MS))
            self.emergencies.append(SimpleNamespace(at=at))
        return len(self.emergencies)

    @property
    def ms(self) -> float:
        return -1.0 if self.silent_at is None else (self.now - self.silent_at) / NS_PER_MS

    def session(self) -> Session:
        here = self

        class Timed(SimpleNamespace):
            @property
            def clock_now(self) -> Instant:
                return here.now

        @contextmanager
        def armed() -> Iterator[None]:
            self.notes.append("armed")
            yield

        control = SimpleNamespace(read_state=self._state)
        drive = SimpleNamespace(
            control=control, take_readings=self._readings, enable=self._enable, reset_fault=self._reset
        )
        made = Timed(
            unwatched=False,
            request=SimpleNamespace(heartbeat_timeout_ms=TIMEOUT_MS, heartbeat_ms=50),
            stop=SimpleNamespace(armed=armed),
            network=self,
            drive=drive,
            found=SimpleNamespace(period=PERIOD),
            wait=lambda seconds: self.notes.append(f"wait {seconds:g} s"),
            deadline=lambda seconds: seconds,
            calm=lambda: self.notes.append("calm"),
            configure=lambda: self.notes.append("configured"),
            check_stop=self._check_stop,
        )
        return cast(Session, made)

    def _enable(self, deadline: float) -> None:
        self.notes.append(f"enable within {deadline:g} s")
        if self.failing is not None:
            raise self.failing

    def _reset(self, deadline: float) -> None:
        self.notes.append(f"reset within {deadline:g} s")

    def _state(self) -> State | None:
        self.asked_ms.append(self.ms)
        return self.state(self.ms)

    def _readings(self) -> list[Reading]:
        word = self.word(self.ms) if self._synced else None
        self._synced = False
        if word is None:
            return []
        return [Reading(0.0, None, self.now, 0.0, self.now, 0.0, self.now, word, self.now)]

    def _check_stop(self) -> None:
        if self.ms >= self.stop_ms:
            raise Interrupted("ended by SIGTERM")

    def pump(self, until: Instant) -> None:
        self.now = max(self.now, until)

    def send_sync(self) -> None:
        self._synced = True

    def resume_life_signs(self) -> None:
        self.notes.append("life")

    def withhold_life_signs(self) -> None:
        self.notes.append("silence")
        self.silent_at = self.now


BEFORE = ["armed", "enable within 3 s", "life", "silence", "life", "wait 0.15 s"]


def proved(watched: Watched) -> StepOutcome:
    outcome = StepOutcome()
    Watchdog().run(watched.session(), outcome)
    return outcome


def leaves_at(ms: float, word: int = DISABLED) -> Callable[[float], int | None]:
    return lambda passed: word if passed >= ms else ENABLED


def test_the_drive_is_seen_to_leave_operation_enabled() -> None:
    watched = Watched(leaves_at(160.0), lambda _ms: State.SWITCH_ON_DISABLED)
    outcome = proved(watched)
    assert outcome.lines == [
        "left 'operation enabled' for 'switch on disabled' 160.0 ms after the last heartbeat"
    ]
    assert outcome.figures == {"reaction_ms": 160.0, "timeout_ms": 150}
    assert watched.notes == [*BEFORE, "calm", "configured"]
    assert len(watched.asked_ms) == 1, "at the end only"


@pytest.mark.parametrize("state", [State.FAULT, State.FAULT_REACTION])
def test_a_fault_that_the_silence_made_is_reset(state: State) -> None:
    watched = Watched(leaves_at(150.0, FAULT), lambda _ms: state)
    assert proved(watched).figures["reaction_ms"] == 150.0
    assert watched.notes == [*BEFORE, "reset within 3 s", "calm", "configured"]


@pytest.mark.parametrize(("ms", "late"), [(245.0, False), (246.0, True)])
def test_a_reaction_after_half_as_long_again_and_20_ms_is_too_late(ms: float, late: bool) -> None:
    watched = Watched(leaves_at(ms))
    if not late:
        assert proved(watched).figures["reaction_ms"] == ms
        return
    with pytest.raises(StepFailed) as caught:
        proved(watched)
    assert (caught.value.summary, caught.value.evidence) == (
        "the drive reacts too late",
        "246 ms, 150 ms were set",
    )
    assert watched.notes[-1] == "configured"


def test_four_time_outs_are_waited_for() -> None:
    watched = Watched(leaves_at(math.inf))
    with pytest.raises(StepFailed) as caught:
        proved(watched)
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "the drive stays enabled without its host",
        "600 ms after the last heartbeat",
        "1016h, 100Ch or 6007h does not work in this drive: do not go on",
    )
    assert watched.ms == 599.0
    assert watched.notes == [*BEFORE, "calm", "configured"]


def test_an_emcy_has_the_state_asked_for_and_is_the_instant() -> None:
    """It came between two looks."""
    watched = Watched(leaves_at(math.inf), lambda _ms: State.FAULT, emergency_ms=152.25)
    assert proved(watched).figures["reaction_ms"] == 152.25


def test_an_emcy_of_a_drive_that_goes_on_is_asked_about_once() -> None:
    watched = Watched(leaves_at(160.0), emergency_ms=100.0)
    assert proved(watched).figures["reaction_ms"] == 160.0
    assert watched.asked_ms[0] == 100.0
    assert len(watched.asked_ms) == 2


def test_readings_that_stay_away_for_five_periods_have_the_state_asked_for() -> None:
    """The last one came at 100 ms."""

    def told(passed: float) -> int | None:
        return ENABLED if passed <= 100.0 else None

    watched = Watched(told, lambda ms: None if ms >= 110.0 else State.OPERATION_ENABLED)
    outcome = proved(watched)
    assert watched.asked_ms[:2] == [106.0, 112.0]
    assert outcome.figures["reaction_ms"] == 112.0
    assert outcome.lines == [
        "left 'operation enabled' for an unknown state 112.0 ms after the last heartbeat"
    ]


def test_whatever_ends_the_proof_the_life_signs_go_on() -> None:
    for watched in (
        Watched(leaves_at(math.inf), stop_ms=80.0),
        Watched(leaves_at(math.inf), failing=PeerFault("no DC link")),
    ):
        with pytest.raises((Interrupted, PeerFault)):
            proved(watched)
        assert watched.notes[-2:] == ["life", "wait 0.15 s"]


def unwatched(answer: str | None) -> tuple[Session, list[str]]:
    """A drive that does not watch its host, with somebody who gives this answer, or nobody."""
    said: list[str] = []

    def line(question: str, _idle: Any) -> str:
        said.append(question)
        assert answer is not None
        return answer

    dialog = SimpleNamespace(tell=said.append, attended=answer is not None, line=line)
    return session_of(Shaft(TRUTH), unwatched=True, dialog=dialog, idle=lambda: None), said


@pytest.mark.parametrize("answer", [None, "yes", " YES "])
def test_a_drive_without_a_watch_is_borne_by_somebody_who_stands_by(answer: str | None) -> None:
    session, said = unwatched(answer)
    outcome = StepOutcome()
    Watchdog().run(session, outcome)
    rpm = LIMITS.speed_rad_s * 30.0 / math.pi
    assert said[0] == (
        "    Nothing stops this drive if host, cable or adapter fail: it goes on with its last command. It "
        f"is given {LIMITS.torque_nm:.4g} N m and {rpm:.0f} r/min at most, and few turns. Somebody has to "
        "stand at its emergency stop."
    )
    assert said[1:] == ([] if answer is None else ["    Type yes if you do."])
    assert outcome.faults == ["the drive does not notice that its host is gone; its motions were limited"]
    assert outcome.figures == {"reaction_ms": None, "timeout_ms": None}


@pytest.mark.parametrize("answer", ["", "y", "no"])
def test_without_somebody_who_stands_by_it_ends(answer: str) -> None:
    with pytest.raises(StepFailed, match=r"^nobody stands by to stop the drive$"):
        Watchdog().run(unwatched(answer)[0], StepOutcome())


def test_the_plan_of_the_proof() -> None:
    assert Watchdog().plan(Watched(leaves_at(0.0)).session()) == (
        "enable the drive at rest, stop the host's heartbeat, and time how long it stays enabled (150 ms are "
        "set in the drive); a fault that this causes is reset"
    )
    session, _ = unwatched(None)
    assert Watchdog().plan(session) == "have somebody stand by, as the drive does not watch its host"
