"""A drive's faults in words, and their reset on the user's word alone."""

from collections.abc import Iterator

import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import DriveInFault
from servobench.hil.cli import app
from servobench.hil.inspecting.drive_fault import look_at_fault
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

Bench = tuple[FakeBus, FakeServo, CanopenNetwork]


@pytest.fixture
def bench() -> Iterator[Bench]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network
    bus.shutdown()


def fall(servo: FakeServo, code: int) -> None:
    for place, kind, value in (((0x1001, 0), "B", 0x21), ((0x1003, 0), "B", 2)):
        servo.types[place], servo.values[place] = kind, value
    for sub, entry in ((1, code), (2, 0x00013210)):
        servo.types[0x1003, sub], servo.values[0x1003, sub] = "I", entry
    servo.fault(code)


def test_a_healthy_drive(bench: Bench) -> None:
    _, _, network = bench
    told = look_at_fault(network, 1, reset=True)
    assert (told.in_fault, told.was_reset, told.state) == (False, False, "switch on disabled")
    assert told.as_json()["error_code"] == "0x0000"


def test_a_fault_in_words_and_not_reset(bench: Bench) -> None:
    _, servo, network = bench
    fall(servo, 0x7392)
    servo.values[0x1018, 1], servo.texts[0x1008, 0] = 0xFB, b"EPOS4"
    told = look_at_fault(network, 1, reset=False)
    assert told.in_fault
    assert servo.state is State.FAULT
    assert servo.control_history == []
    text = "\n".join(told.lines())
    assert "error code 7392h: main sensor counts the wrong way; sensor" in text
    assert "error register 21h: generic, device profile" in text
    assert "before: 00013210h: over-voltage" in text


def test_without_603f_the_history_tells(bench: Bench) -> None:
    _, servo, network = bench
    fall(servo, 0x8611)
    del servo.types[0x603F, 0]
    told = look_at_fault(network, 1, reset=False)
    assert (told.error_code, told.error) == (0x8611, "following error")


def test_the_users_word_resets_it(bench: Bench) -> None:
    _, servo, network = bench
    fall(servo, 0x8611)
    told = look_at_fault(network, 1, reset=True)
    assert (told.in_fault, told.was_reset) == (False, True)
    assert 0x80 in servo.control_history


def test_a_bus_without_drives_is_refused() -> None:
    result = CliRunner().invoke(app, ["fault", "--bus", "simulated", "--node", "1"])
    assert result.exit_code == 2


def test_a_fault_that_stays_is_an_error(bench: Bench) -> None:
    _, servo, network = bench
    fall(servo, 0x8611)
    servo.stubborn.add((0x6040, 0))
    with pytest.raises(DriveInFault, match="did not leave its fault"):
        look_at_fault(network, 1, reset=True)
