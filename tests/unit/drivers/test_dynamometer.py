"""The driver of the load machine against a scripted instrument, on a clock that the test moves."""

from collections.abc import Callable
from itertools import chain, repeat

import pytest

from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.instruments.dynamometer import (
    ATTEMPTS_MAX,
    TORQUE_UNITS_NM,
    Dynamometer,
    DynamometerSettings,
    dialect,
)
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.serial_line import LineFull, LineGone

TIMEOUT = Duration(100 * NS_PER_MS)
SETTINGS = DynamometerSettings(baud=9600, answer_timeout=TIMEOUT, reading_every=Duration(10 * NS_PER_MS))


class Clock:
    """Time as the test wants it."""

    def __init__(self) -> None:
        self.instant = Instant(0)

    def now(self) -> Instant:
        return self.instant

    def sleep_until(self, when: Instant) -> None:
        self.instant = max(self.instant, when)


class ScriptedLine:
    """Answers each command as ``answer`` says, ``delay_ns`` later and all at once."""

    def __init__(self, clock: Clock, answer: Callable[[bytes], bytes]) -> None:
        self.name = "scripted"
        self.sent: list[bytes] = []
        self.answer = answer
        self.delay_ns = 20 * NS_PER_MS
        self.failure: OSError | None = None
        self.closed = False
        self._clock = clock
        self._coming: list[tuple[int, bytes]] = []

    def read(self) -> bytes:
        if self.failure is not None:
            raise self.failure
        now = self._clock.now()
        come = [data for at, data in self._coming if at <= now]
        self._coming = [one for one in self._coming if one[0] > now]
        return b"".join(come)

    def write(self, data: bytes) -> None:
        if self.failure is not None:
            raise self.failure
        self.sent.append(data)
        reply = self.answer(data)
        if reply:
            self._coming.append((self._clock.now() + self.delay_ns, reply))

    def close(self) -> None:
        self.closed = True


def healthy(command: bytes) -> bytes:
    return {b"OD1\r\n": b"S  1500T0.600R\r\n", b"*IDN?\r\n": b"MAGTROL DSP7001\r\n"}.get(command, b"")


Bench = tuple[Dynamometer, ScriptedLine, Clock]


@pytest.fixture
def bench() -> Bench:
    clock = Clock()
    line = ScriptedLine(clock, healthy)
    return Dynamometer(line, clock, dialect("magtrol_dsp7000"), SETTINGS), line, clock


def run(bench: Bench, seconds: float) -> None:
    """A loop at 1 kHz."""
    dynamometer, _, clock = bench
    for _ in range(round(seconds * 1000)):
        dynamometer.pump(clock.now())
        clock.sleep_until(Instant(clock.now() + NS_PER_MS))


def test_data_strings_of_the_manuals_are_read() -> None:
    seen = dialect("magtrol_dsp6001", unit="oz.in").read(b"S 1725T22.60R")
    assert seen is not None
    assert seen.speed_rad_s == pytest.approx(1725 * RAD_S_PER_RPM)
    assert seen.torque_nm == pytest.approx(22.60 * 0.00706155, rel=1e-5)
    left = dialect("magtrol_dsp7000").read(b"S   300T0.100L")
    assert left is not None
    assert left.speed_rad_s == pytest.approx(-300 * RAD_S_PER_RPM)
    turned = dialect("magtrol_dsp7000", clockwise_is_positive=False).read(b"S   300T0.100L")
    assert turned is not None
    assert turned.speed_rad_s > 0
    alarm = dialect("magtrol_dsp7000").read(b"S     0T0.000A")
    assert alarm is not None
    assert alarm.alarm


@pytest.mark.parametrize(
    "line",
    b"|S|S1500T0.6|S15x0T0.600R|1500T0.600R|S1500T600R|S1500T0.600X|S1500T.R|S1500T0.600RS1500"
    b"|S1500\xffT0.600R|MAGTROL|S1500T0.600R R".split(b"|"),
)
def test_spoilt_data_strings_are_none(line: bytes) -> None:
    assert dialect("magtrol_dsp7000").read(line) is None


def test_set_points_are_written_as_each_model_wants_them() -> None:
    assert dialect("magtrol_dsp7000").set_torque(0.6) == b"Q1,0.600\r\n"
    assert dialect("magtrol_dsp7000", channel=2).set_torque(0.0) == b"Q2\r\n"
    assert dialect("magtrol_dsp6001", unit="N.mm").set_torque(0.6) == b"Q600.000\r\n"
    assert dialect("magtrol_dsp6001").set_torque(1e-5) == b"Q\r\n"
    assert TORQUE_UNITS_NM["lb.ft"] == pytest.approx(12 * TORQUE_UNITS_NM["lb.in"], rel=1e-6)
    with pytest.raises(ValueError, match="no channel 2"):
        dialect("magtrol_dsp6001", channel=2)


def test_connecting_opens_the_brake_first_and_names_the_instrument(bench: Bench) -> None:
    dynamometer, line, clock = bench
    assert dynamometer.connect(clock.sleep_until) == "MAGTROL DSP7001"
    assert line.sent[0] == b"Q1\r\n"


def test_connecting_to_nobody_is_an_error_that_says_what_to_check(bench: Bench) -> None:
    dynamometer, line, clock = bench
    line.answer = lambda _: b""
    with pytest.raises(NoAnswer, match=r"no load machine answers on scripted.*null modem"):
        dynamometer.connect(clock.sleep_until)
    assert line.sent.count(b"*IDN?\r\n") == ATTEMPTS_MAX


def test_readings_are_stamped_between_request_and_answer(bench: Bench) -> None:
    dynamometer, line, _ = bench
    run(bench, 0.5)
    readings = dynamometer.take_readings()
    assert len(readings) > 15
    for reading in readings:
        assert reading.torque_nm == pytest.approx(0.6)
        assert reading.speed_rad_s == pytest.approx(157.08, abs=0.01)
        assert not reading.alarm
    # 20 ms after the request, of which the request took 5.2 ms and the answer 16.7 ms of line
    first = readings[0]
    assert first.at <= 20 * NS_PER_MS
    assert first.error_ns <= 10 * NS_PER_MS
    assert line.sent.count(b"OD1\r\n") == len(readings) + 1
    assert dynamometer.take_readings() == []


def test_a_set_point_goes_out_at_once_and_again_as_nobody_confirms_it(bench: Bench) -> None:
    dynamometer, line, clock = bench
    dynamometer.set_torque(0.6)
    assert line.sent == [b"Q1,0.600\r\n"]
    run(bench, 2.0)
    assert 4 <= line.sent.count(b"Q1,0.600\r\n") <= 6
    dynamometer.set_torque(0.0)
    assert line.sent[-1] == b"Q1\r\n"
    assert clock.now() == 2 * NS_PER_S


def test_spoilt_answers_are_counted_and_asked_for_again(bench: Bench) -> None:
    dynamometer, line, _ = bench
    answers = iter([b"S  15\r\n", b"\xff\xff\r\n", b"S  1500T0.600R\r\n", b"S  1500T0.6", b""] * 50)
    line.answer = lambda command: next(answers) if command == b"OD1\r\n" else b""
    run(bench, 2.0)
    assert dynamometer.tally.spoilt > 5
    assert dynamometer.tally.late > 2
    readings = dynamometer.take_readings()
    assert len(readings) > 5
    assert {reading.torque_nm for reading in readings} == {0.6}


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r", b"\n\r", b"\r\r\n"])
def test_any_terminator_will_do(bench: Bench, end: bytes) -> None:
    dynamometer, line, _ = bench
    line.answer = lambda command: b"S  1500T0.600R" + end if command == b"OD1\r\n" else b""
    run(bench, 0.2)
    assert dynamometer.tally.readings > 4
    assert dynamometer.tally.spoilt == dynamometer.tally.late == 0


def test_an_instrument_that_falls_silent_is_lost(bench: Bench) -> None:
    _, line, clock = bench
    run(bench, 0.1)
    line.answer = lambda _: b""
    began = clock.now()
    with pytest.raises(NoAnswer, match=r"gives no readings.*3 answers did not come and 0"):
        run(bench, 2.0)
    assert clock.now() - began < (ATTEMPTS_MAX + 1) * 130 * NS_PER_MS


def test_an_instrument_that_speaks_gibberish_is_lost_too(bench: Bench) -> None:
    _, line, _ = bench
    line.answer = lambda _: b"\xf0\x80\x0d"
    with pytest.raises(NoAnswer, match="baud rate"):
        run(bench, 2.0)


@pytest.mark.parametrize("failure", [LineGone("scripted is gone"), LineFull("scripted takes no more")])
def test_a_port_that_fails_is_a_fault_of_the_load_machine(bench: Bench, failure: OSError) -> None:
    dynamometer, line, _ = bench
    run(bench, 0.1)
    line.failure = failure
    with pytest.raises(PeerFault, match="load machine"):
        dynamometer.set_torque(0.3)
    with pytest.raises(PeerFault):
        run(bench, 0.1)


def test_an_alarm_ends_the_run(bench: Bench) -> None:
    _, line, _ = bench
    line.answer = lambda command: b"S  1500T0.600A\r\n" if command == b"OD1\r\n" else b""
    with pytest.raises(PeerFault, match="in alarm"):
        run(bench, 0.2)


def test_taking_off_is_over_when_the_torque_is_gone(bench: Bench) -> None:
    dynamometer, line, clock = bench
    dynamometer.set_torque(0.6)
    run(bench, 0.1)
    torques = chain([0.6, 0.4, 0.1, 0.01], repeat(9.0))
    line.answer = lambda command: b"S  1500T%.3fR\r\n" % next(torques) if command == b"OD1\r\n" else b""
    dynamometer.take_off(clock.sleep_until)
    assert next(torques) == 9.0, "it was content too soon"
    assert b"Q1\r\n" in line.sent


def test_a_brake_that_stays_on_is_told(bench: Bench) -> None:
    dynamometer, _, clock = bench
    dynamometer.set_torque(0.6)
    with pytest.raises(PeerFault, match=r"still brakes.*0\.6 N m.*by hand"):
        dynamometer.take_off(clock.sleep_until)
