"""How a drive is disabled, stopped and let go."""

from collections.abc import Iterator

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import NoAnswer
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

SETTINGS = DriveSettings(Duration(NS_PER_MS), torque_max_nm=5.0, speed_max_rad_s=250.0)
RPDO, SDO = 0x201, 0x601
RAMP_NS = 40 * NS_PER_MS
FAST = 1_500_000
"""0x606C of a shaft that turns with 1500 r/min."""
DISABLE_VOLTAGE, QUICK_STOP, DISABLE_OPERATION = 0, 2, 7
PRE_OPERATIONAL = 0x7F


class RampingServo(FakeServo):
    """Goes down its ramp before it leaves OPERATION ENABLED on DISABLE OPERATION, as 0x605C = 1 has it."""

    def __init__(self, bus: FakeBus) -> None:
        super().__init__(bus)
        self.met: list[tuple[int, State]] = []
        """Each controlword, and the state that it came in."""

    def _control(self, word: int) -> None:
        self.met.append((word, self.state))
        if word == DISABLE_OPERATION and self.state is State.OPERATION_ENABLED:
            self.bus.call_after(RAMP_NS, self._ramp_done)
        else:
            super()._control(word)

    def _ramp_done(self) -> None:
        if self.state is State.OPERATION_ENABLED:
            self.state = State.SWITCHED_ON


Bench = tuple[FakeBus, RampingServo, CanopenNetwork, ServoDrive]


@pytest.fixture
def bench() -> Iterator[Bench]:
    """An enabled drive that was sent a torque."""
    bus, network = make_network()
    servo, drive = RampingServo(bus), ServoDrive(network, 1, "axis1")
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    drive.configure(SETTINGS)
    drive.enable(network.deadline_after(Duration(NS_PER_S)))
    now = network.clock.now()
    drive.write(Command(1, 1.0, now, now))
    servo.met.clear()
    bus.sent.clear()
    yield bus, servo, network, drive
    bus.shutdown()


def soon(bench: Bench) -> Instant:
    return bench[2].deadline_after(Duration(NS_PER_S))


def wait(bench: Bench, milliseconds: int) -> None:
    _, _, network, _ = bench
    network.pump(network.deadline_after(Duration(milliseconds * NS_PER_MS)))


@pytest.mark.parametrize("leave", ["disable", "stop", "quick_stop", "release"])
def test_a_drive_that_is_let_go_gets_no_torque_and_is_asked_for_nothing(bench: Bench, leave: str) -> None:
    bus, servo, _, drive = bench
    assert drive.enabled
    assert servo.values[0x6071, 0] == 500
    getattr(drive, leave)(*([soon(bench)] if leave in ("disable", "quick_stop") else []))
    assert not drive.enabled
    assert {data[2:] for data in bus.sent_to(RPDO)} == {b"\0\0"}
    wait(bench, 50)
    drive.check()


# ---- disable ----------------------------------------------------------------------------------------------


def test_the_ramp_is_waited_for_before_the_voltage_is_taken_off(bench: Bench) -> None:
    bus, servo, _, drive = bench
    began = bus.now()
    drive.disable(soon(bench))
    assert servo.state is State.SWITCH_ON_DISABLED
    assert (DISABLE_VOLTAGE, State.OPERATION_ENABLED) not in servo.met, "the shaft would coast"
    assert bus.now() - began >= RAMP_NS


# ---- stop -------------------------------------------------------------------------------------------------


def test_a_drive_that_was_never_connected_is_sent_no_stop() -> None:
    bus, network = make_network()
    FakeServo(bus)
    ServoDrive(network, 1).stop()
    assert bus.sent == []
    bus.shutdown()


def test_a_stop_that_does_not_ask_is_one_frame_and_no_wait(bench: Bench) -> None:
    bus, _, _, drive = bench
    began = bus.now()
    drive.stop(asking=False)
    assert [(frame.can_id, frame.data) for _, frame in bus.sent] == [(RPDO, b"\x02\0\0\0")]
    assert bus.now() == began


def test_a_stop_reaches_a_drive_that_takes_no_rpdo(bench: Bench) -> None:
    """By SDO; it waits for neither the shaft nor the state."""
    bus, servo, _, drive = bench
    servo.nmt_state = PRE_OPERATIONAL
    began = bus.now()
    drive.stop()
    assert servo.met == [(QUICK_STOP, State.OPERATION_ENABLED)]
    assert servo.state is State.QUICK_STOP
    assert bus.now() - began < servo.stop_ns


def test_a_drive_that_is_not_enabled_is_sent_no_stop_by_sdo(bench: Bench) -> None:
    """The word has no effect there, and a drive may refuse it."""
    _, servo, _, drive = bench
    servo.state = State.SWITCHED_ON
    servo.nmt_state = PRE_OPERATIONAL
    servo.refuse[0x6040, 0] = 0x08000022
    drive.stop()
    assert servo.met == []


# ---- quick_stop -------------------------------------------------------------------------------------------


def test_a_drive_that_holds_after_a_quick_stop_is_disabled(bench: Bench) -> None:
    """605Ah = 6: it stays in QUICK STOP ACTIVE."""
    _, servo, _, drive = bench
    servo.values[0x605A, 0] = 6
    servo.values[0x606C, 0] = FAST
    drive.quick_stop(soon(bench))
    assert servo.state is State.SWITCH_ON_DISABLED
    assert servo.values[0x606C, 0] == 0, "the voltage was taken off a shaft that turned"


def test_a_shaft_that_takes_long_to_stop_leaves_the_bus_to_others(bench: Bench) -> None:
    """A shaft of much inertia: state and speed are asked for a hundred times a second, by four frames."""
    bus, servo, _, drive = bench
    servo.values[0x605A, 0] = 6
    servo.values[0x606C, 0] = FAST
    servo.stop_ns = 900 * NS_PER_MS
    began = bus.now()
    drive.quick_stop(soon(bench))
    assert 900 <= (bus.now() - began) / NS_PER_MS <= 930
    assert servo.state is State.SWITCH_ON_DISABLED
    assert 160 <= len(bus.sent_to(SDO)) <= 200


def test_the_reaction_to_a_fault_is_waited_out_and_the_fault_left_alone(bench: Bench) -> None:
    bus, servo, _, drive = bench
    servo.state = State.FAULT_REACTION
    servo.values[0x606C, 0] = FAST

    def at_rest() -> None:
        servo.state = State.FAULT
        servo.values[0x606C, 0] = 0

    bus.call_after(RAMP_NS, at_rest)
    began = bus.now()
    drive.quick_stop(soon(bench))
    assert bus.now() - began >= RAMP_NS
    assert servo.state is State.FAULT
    assert {word for word, _ in servo.met} == {QUICK_STOP}


# ---- release ----------------------------------------------------------------------------------------------


def test_a_drive_that_was_never_connected_is_not_watched_after_a_release() -> None:
    bus, network = make_network()
    drive = ServoDrive(network, 1)
    assert drive.release().evidence == "it was never connected"
    assert not drive.enabled
    bus.shutdown()


def test_a_released_drive_may_be_switched_off(bench: Bench) -> None:
    _, servo, _, drive = bench
    released = drive.release()
    assert (released.at_rest, released.state) == (True, State.SWITCH_ON_DISABLED)
    assert (released.evidence, released.unwatched) == ("", "")
    servo.silent = True
    wait(bench, 1000)
    assert drive.status.lost_at is None
    drive.check()


def test_a_drive_that_rests_but_does_not_forget_the_host_is_told_as_such(bench: Bench) -> None:
    bus, servo, _, drive = bench
    began = bus.now()
    servo.refuse[0x1016, 1] = 0x08000022
    released = drive.release()
    assert released.at_rest
    assert released.state is State.SWITCH_ON_DISABLED
    assert "1016h:01" in released.evidence
    assert "08000022h" in released.evidence
    assert released.rested_at is not None
    assert began < released.rested_at < bus.now()


def test_a_drive_that_did_not_watch_the_host_is_told_as_such(bench: Bench) -> None:
    _, servo, _, drive = bench
    servo.values[0x1016, 1] = 0
    released = drive.release()
    assert released.at_rest
    assert released.unwatched == (
        "1016h:01 held 00000000h at the end, 007F0096h was written: it did not watch the host"
    )


def test_no_stop_is_tried_again_at_the_limit(bench: Bench) -> None:
    """The first one ends at that very instant."""
    bus, servo, _, drive = bench
    servo.silent = True
    began = bus.now()
    with pytest.raises(NoAnswer):
        drive.stop()
    attempt = Duration(bus.now() - began)
    began, sent = bus.now(), len(bus.sent_to(RPDO))
    assert not drive.release(attempt).at_rest
    assert bus.now() - began == attempt
    assert len(bus.sent_to(RPDO)) == sent + 1
    sent = len(bus.sent_to(RPDO))
    assert not drive.release(Duration(attempt + 1)).at_rest
    assert len(bus.sent_to(RPDO)) == sent + 2, "there was time for another"
