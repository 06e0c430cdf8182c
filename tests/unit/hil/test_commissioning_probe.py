"""Torque switched to and fro on a drive that answers as a lag of first order behind a dead time."""

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.exchange import Command, Reading, SentCommand
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from servobench.hil.commissioning.command_probe import CommandProbe, TorqueSlope, switches, torque_slope
from servobench.hil.commissioning.excitation import StepLag
from servobench.hil.commissioning.findings import ReadingsLost, StatedFigure, StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_dynamics import Delays
from servobench.hil.execution.segments import timing_without_bench
from tests.unit.hil.simulated_shaft import LIMITS, PERIOD, RATED_NM, Shaft, session_of, shaft_of

DEAD_US: Final = 300.0
LAG_US: Final = 150.0
READING_US: Final = 160.0
STEP_NM: Final = 0.1 * RATED_NM
"""A quarter of the limit of 0.8 N m is more."""


@dataclass
class Bus:
    """Time, SYNCs and a drive, whose torque follows a command from ``dead_us`` behind it on."""

    period: Duration = PERIOD
    bitrate: int = 1_000_000
    dead_us: float = DEAD_US
    lag_us: float = LAG_US
    now: Instant = field(default_factory=lambda: Instant(7 * NS_PER_MS))
    syncs: list[Instant] = field(default_factory=list)
    sent: list[tuple[Instant, float]] = field(default_factory=list)
    expiries: list[Instant] = field(default_factory=list)
    unheard: set[int] = field(default_factory=set)
    """Commands that the drive does not get, by their number from 0."""
    unsent: set[int] = field(default_factory=set)
    """Those that are too late to be sent."""
    unanswered: set[int] = field(default_factory=set)
    """SYNCs without a reading."""
    stalls: dict[int, int] = field(default_factory=dict)
    """ns by which the host is late for a SYNC."""
    mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    slope: int = 0
    checks: int = 0
    _asked: int = 0
    _waiting: list[Reading] = field(default_factory=list)
    _shown: tuple[float, Instant] = (0.0, Instant(0))
    _torque: float = 0.0
    _target: float = 0.0
    _torque_at: float = 0.0
    _heard: deque[tuple[float, float]] = field(default_factory=deque)

    def session(self, **more: Any) -> Session:
        bus = self
        timing = timing_without_bench(self.period, self.bitrate, Duration(0))
        self.latency = timing.sync_latency

        class Timed(SimpleNamespace):
            @property
            def clock_now(self) -> Instant:
                return bus.now

        @contextmanager
        def enabled() -> Iterator[None]:
            yield

        class Drive(SimpleNamespace):
            @property
            def torque_shown(self) -> tuple[float, Instant]:
                return bus._shown

        shaft = Shaft(shaft_of(1e-3), mode=self.mode)
        shaft.objects.held[Object.TORQUE_SLOPE, 0] = self.slope
        plain = vars(cast(Any, session_of(shaft)))
        plain["found"].period = self.period
        drive = Drive(rated_torque_nm=RATED_NM, take_readings=self._readings)
        mine = {
            "network": SimpleNamespace(pump=self._pump, send_sync=self._sync),
            "drive": drive,
            "port": SimpleNamespace(write=self._write, check=self._check),
            "timing": lambda: timing,
            "check_stop": lambda: None,
            "enabled": enabled,
        }
        return cast(Session, Timed(**{**plain, **mine, **more}))

    def _check(self) -> None:
        self.checks += 1

    def _pump(self, until: Instant) -> None:
        for_a_sync = len(self.syncs) == self._asked
        late = self.stalls.pop(len(self.syncs), 0) if for_a_sync else 0
        self.now = Instant(max(self.now, until + late))

    def _sync(self) -> Instant:
        number = len(self.syncs)
        self.syncs.append(self.now)
        sampled = Instant(self.now + self.latency)
        if number not in self.unanswered:
            self._shown = (self._torque_then(sampled), sampled)
            arrives = Instant(sampled + round(READING_US * NS_PER_US))
            at = self.now
            self._waiting.append(Reading(0.0, None, arrives, 0.0, at, 0.0, at, 0, at))
        return self.now

    def _readings(self) -> list[Reading]:
        come = [each for each in self._waiting if each.received_at <= self.now]
        self._waiting = [each for each in self._waiting if each.received_at > self.now]
        return come

    def _write(self, command: Command) -> SentCommand | None:
        number, self._asked = self._asked, self._asked + 1
        if number in self.unsent:
            return None
        self.sent.append((self.now, command.torque_nm))
        self.expiries.append(command.expires_at)
        if number not in self.unheard:
            self._heard.append((self.now + 1e3 * self.dead_us, command.torque_nm))
        return SentCommand(command.sequence, 0, self.now)

    def _torque_then(self, at: int) -> float:
        """The answer to all that was heard until then."""
        while self._heard and self._heard[0][0] <= at:
            begin, torque = self._heard.popleft()
            self._torque = self._answer_at(begin)
            self._torque_at, self._target = begin, torque
        return self._answer_at(at)

    def _answer_at(self, at: float) -> float:
        fade = math.exp(-(at - self._torque_at) / (1e3 * self.lag_us))
        return self._target + (self._torque - self._target) * fade


def timed(bus: Bus) -> tuple[Session, StepOutcome]:
    session, outcome = bus.session(), StepOutcome()
    Delays().run(session, outcome)
    return session, outcome


def test_dead_time_and_lag_of_a_drive_are_found() -> None:
    """Half of a lag's answer is there after ln 2 of it."""
    bus = Bus()
    session, outcome = timed(bus)
    found = session.found
    half_us = DEAD_US + LAG_US * math.log(2.0)
    in_drive_us = DEAD_US + LAG_US - session.timing().command_latency / 1e3
    assert found.effect_delay_us == pytest.approx(half_us, rel=0.01)
    assert found.torque_lag_us == pytest.approx(LAG_US, rel=0.03)
    assert found.reading_delay_us == READING_US
    assert found.current_bandwidth_hz == pytest.approx(1e6 / (math.tau * in_drive_us), rel=0.02)
    figures = outcome.figures
    assert figures == {
        "reading_delay_us": READING_US,
        "reading_delay_p99_us": READING_US,
        "effect_delay_us": found.effect_delay_us,
        "dead_time_us": pytest.approx(DEAD_US, abs=4.0),
        "lag_us": found.torque_lag_us,
        "current_bandwidth_hz": found.current_bandwidth_hz,
        "readings_lost": 0,
        "commands_lost": 0,
        "commands": figures["commands"],
        "cycles": 2002,
    }
    assert outcome.lines == [
        "readings arrive 160 us after the SYNC, 99 % within 160 us; 0 of 2002 were lost",
        f"a command shows half of its effect {found.effect_delay_us:.0f} us after it was sent: "
        f"{figures['dead_time_us']:.0f} us of dead time and a lag of {found.torque_lag_us:.0f} us",
        f"the drive follows it like a current loop of {found.current_bandwidth_hz:.0f} Hz",
        f"0 of {figures['commands']} commands were lost",
    ]
    assert outcome.quantities[2:] == [
        StatedFigure("delay of a command", cast(float, found.effect_delay_us), "us")
    ]
    network = found.network
    assert network is not None
    assert network.delay_max_us == math.ceil(READING_US + cast(float, found.effect_delay_us))
    assert (network.command_losses_in_a_row_max, network.lost) == (0, 0)
    assert cast(Any, session).pictures == ["delays"]


def test_commands_and_readings_that_are_lost_are_counted() -> None:
    """The first of a switch's four commands decides; the second one makes up for it."""
    judged = timed(Bus(dead_us=230.0, lag_us=80.0))[1].figures["commands"]
    assert 50 < judged < 500
    lost = {2 + 4 * number for number in range(100, 500, 20)}
    repeats = {3 + 4 * number for number in range(101, 500, 20)}
    bus = Bus(dead_us=230.0, lag_us=80.0, unheard=lost | repeats, unanswered={50, 51, 90})
    session, outcome = timed(bus)
    assert outcome.figures["readings_lost"] == 3
    assert 0 < outcome.figures["commands_lost"] <= len(lost)
    assert outcome.figures["commands_lost"] == pytest.approx(len(lost) * judged / 500, abs=5.0)
    network = session.found.network
    assert network is not None
    assert (network.lost, network.losses_in_a_row, network.command_losses_in_a_row_max) == (3, (1, 1), 1)


def test_too_few_readings_are_refused_before_lost_ones() -> None:
    with pytest.raises(StepFailed) as caught:
        timed(Bus(unanswered=set(range(99, 9999))))
    assert (caught.value.summary, caught.value.evidence) == ("too few readings came", "99 of 2002")
    with pytest.raises(ReadingsLost):
        timed(Bus(unanswered=set(range(100, 9999))))


def test_a_torque_that_does_not_follow_fails() -> None:
    with pytest.raises(StepFailed) as caught:
        timed(Bus(unheard=set(range(9999))))
    assert caught.value.summary == "the torque does not follow its command"
    assert caught.value.evidence.startswith("the answer to the step does not pass")


def test_a_slope_that_hides_the_command_is_told_with_its_time() -> None:
    """0.32 N m of 1.6 in profile torque mode; the drive moves by 20 thousandths a second."""
    with pytest.raises(StepFailed) as caught:
        timed(Bus(mode=Mode.PROFILE_TORQUE, slope=20, unheard=set(range(9999))))
    summary, _, why = caught.value.evidence.partition("; ")
    assert caught.value.summary == "the torque slope 6087h hides when a command acts"
    assert summary == "20 thousandths a second, 1e+04 ms for 0.32 N m"
    assert why.startswith("the answer to the step does not pass")
    assert caught.value.remedy == (
        "cyclic synchronous torque has no slope; the steepest that the drive takes is set"
    )


@pytest.mark.parametrize(("share", "told"), [(0.9, False), (1.1, True)])
def test_a_slope_that_is_longer_than_the_lag_is_told(share: float, told: bool) -> None:
    lag_us = cast(float, timed(Bus())[0].found.torque_lag_us)
    raw = round(1e9 * 2.0 * STEP_NM / RATED_NM / (share * lag_us))
    _, outcome = timed(Bus(mode=Mode.PROFILE_TORQUE, slope=raw))
    takes_ms = 0.2e6 / raw
    line = f"most of it is the torque slope 6087h: {raw} thousandths a second, {takes_ms:.3g} ms for 0.32 N m"
    assert (line in outcome.lines) is told


@pytest.mark.parametrize(
    ("mode", "raw", "told"),
    [
        (Mode.PROFILE_TORQUE, 1000, ("1000 thousandths a second, 250 ms for 0.4 N m", 250_000.0)),
        (Mode.PROFILE_TORQUE, 0, None),
        (Mode.CYCLIC_SYNCHRONOUS_TORQUE, 1000, None),
    ],
)
def test_what_6087h_makes_of_a_switch(mode: Mode, raw: int, told: tuple[str, float] | None) -> None:
    session = Bus(mode=mode, slope=raw).session()
    assert torque_slope(session, 0.4) == (None if told is None else TorqueSlope(*told))
    held = cast(Any, session.objects).held
    held.clear()
    assert torque_slope(session, 0.4) is None


# ---- when the torque is switched -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("torque_nm", "step_nm"), [(0.8, 0.16), (0.4, 0.1), (0.2, 0.05), (0.1, 0.032), (1e-3, 0.032)]
)
def test_the_torque_is_switched_by_a_quarter_of_its_limit_or_a_tenth_of_its_rating(
    torque_nm: float, step_nm: float
) -> None:
    """But by no less than a fiftieth, which is 20 units of 6077h."""
    bus = Bus()
    limits = replace(LIMITS, torque_nm=torque_nm)
    CommandProbe(bus.session(limits=limits)).run()
    torques = [torque for _, torque in bus.sent]
    expected = [step_nm] * 2
    for number in range(500):
        expected += [(step_nm if number % 2 else -step_nm)] * 4
    assert torques == pytest.approx([*expected, 0.0])


@pytest.mark.parametrize(
    ("period_us", "bitrate", "count", "longest_us"),
    [(1000, 1_000_000, 500, 700.0), (4000, 1_000_000, 250, 700.0), (20_000, 125_000, 150, None)],
)
def test_the_leads_of_the_switches_fill_the_cycle(
    period_us: int, bitrate: int, count: int, longest_us: float | None
) -> None:
    """By the golden section, from 1.25 frames of a command on; longer where such a frame takes long."""
    period = Duration(period_us * NS_PER_US)
    bus = Bus(period, bitrate, dead_us=3e8 / bitrate)
    session = bus.session()
    assert switches(session) == count
    CommandProbe(session).run()
    command_us = session.timing().command_latency / 1e3
    shortest = 1.25 * command_us
    longest = 6.0 * command_us if longest_us is None else longest_us
    assert longest > 2.0 * shortest
    handed = [at for at, _ in bus.sent]
    for number in (0, 1, 2, 77, count - 1):
        lead = shortest + (longest - shortest) * ((number * 0.6180339887498949) % 1.0)
        for cycle in range(4):
            place = 2 + 4 * number + cycle
            assert (bus.syncs[place] + period - handed[place]) / 1e3 == pytest.approx(lead, abs=1e-3)
    assert handed[0] - bus.syncs[0] == period // 2
    lasts = [expiry - at for expiry, at in zip(bus.expiries, handed, strict=True)]
    assert set(lasts) == {period}
    gaps = {later - before for before, later in zip(bus.syncs, bus.syncs[1:], strict=False)}
    assert gaps == {period}, "SYNCs keep their time"
    assert bus.checks == len(bus.syncs) == 2 + 4 * count


def test_a_bus_that_is_slow_switches_within_two_shortest_leads() -> None:
    """Where seven tenths of a period are less than that."""
    period = Duration(500 * NS_PER_US)
    bus = Bus(period, 500_000)
    session = bus.session()
    CommandProbe(session).run()
    shortest = 1.25 * session.timing().command_latency
    assert 2.0 * shortest > 0.7 * period
    leads = [bus.syncs[place] + period - bus.sent[place][0] for place in range(2, 2002, 4)]
    assert min(leads) == pytest.approx(shortest, abs=2.0)
    assert max(leads) == pytest.approx(2.0 * shortest, rel=2e-3)


def test_a_drive_that_is_faster_than_a_command_before_its_sync_is_timed_as_well_as_can_be() -> None:
    """At 125 kbit/s the youngest answer shows the whole step, and none comes behind a SYNC."""
    bus = Bus(Duration(20 * NS_PER_MS), 125_000)
    session, outcome = timed(bus)
    timing = session.timing()
    hidden_us = 1e-3 * (1.25 * timing.command_latency + timing.sync_latency)
    assert len(bus.syncs) == 2 + 4 * 150 + 4 * 150
    assert session.found.effect_delay_us == pytest.approx(0.5 * hidden_us, abs=0.5 * hidden_us)
    assert session.found.current_bandwidth_hz is None
    assert f"give or take {0.5 * hidden_us:.0f} us" in outcome.lines[1]


def answers(bus: Bus) -> int:
    probe = CommandProbe(bus.session())
    probe.run()
    return len(probe.answers)


def test_switches_are_judged_once_nine_tenths_of_their_effect_must_be_there() -> None:
    """Twice the lag behind the half: 500 us; less than three tenths of the step is none of it."""
    probe = CommandProbe(Bus().session())
    probe.firsts = [(500.0, 0.0), (500.5, 0.0), (501.0, 0.299), (900.0, 0.3), (900.0, 1.0), (100.0, 0.0)]
    probe.judge_commands(StepLag(100.0, 0.0, 200.0, 0.0))
    assert (probe.commands, probe.commands_lost) == (4, 2)
