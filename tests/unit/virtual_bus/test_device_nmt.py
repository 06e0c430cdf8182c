"""NMT: states, commands, boot-up and what each state serves (CiA 301, 7.2.8.2, 7.3.2)."""

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.device_bench import (
    LEVEL,
    NODE,
    NOTE,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Bench,
    operational,
)

BOOT_UP = Frame(0x700 + NODE, b"\x00")
TARGETS = {
    START: NmtState.OPERATIONAL,
    STOP: NmtState.STOPPED,
    PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


def test_boots_up_into_pre_operational() -> None:
    bench = Bench()
    assert [frame for _, frame in bench.sent] == [BOOT_UP]
    assert bench.device.state is NmtState.PRE_OPERATIONAL
    assert bench.application.calls == [("reset", 0), ("nmt", NmtState.PRE_OPERATIONAL, 0)]


@pytest.mark.parametrize("first", TARGETS)
@pytest.mark.parametrize("second", TARGETS)
@pytest.mark.parametrize("node", [0, NODE])
def test_every_state_takes_every_command(first: int, second: int, node: int) -> None:
    bench = Bench()
    bench.nmt(first)
    bench.nmt(second, node)
    assert bench.device.state is TARGETS[second]


@pytest.mark.parametrize("state", TARGETS)
@pytest.mark.parametrize("reset", [RESET_NODE, RESET_COMMUNICATION])
def test_both_resets_boot_up_from_every_state(state: int, reset: int) -> None:
    bench = Bench()
    bench.nmt(state)
    bench.application.calls.clear()
    assert bench.nmt(reset) == [BOOT_UP]
    assert bench.device.state is NmtState.PRE_OPERATIONAL
    states = [call[1] for call in bench.application.calls if call[0] == "nmt"]
    assert states == [NmtState.INITIALISING, NmtState.PRE_OPERATIONAL]
    assert (("reset", 0) in bench.application.calls) == (reset == RESET_NODE)


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x05\x00", b"\x01\x06", b"\x03\x05", b"\x00\x05"])
def test_other_commands_leave_the_state(data: bytes) -> None:
    bench = Bench()
    assert bench.put(0, data) == []
    assert bench.device.state is NmtState.PRE_OPERATIONAL


def test_reset_of_communication_keeps_the_application_objects() -> None:
    bench = Bench()
    bench.write(0x1017, 0, 100, 2)
    bench.write(LEVEL, 0, 42, 4)
    bench.nmt(RESET_COMMUNICATION)
    assert (bench.read(0x1017), bench.read(LEVEL)) == (0, 42)
    bench.nmt(RESET_NODE)
    assert bench.read(LEVEL) == 7


def test_stopped_serves_neither_sdo_nor_pdo_nor_sync() -> None:
    bench = operational()
    bench.nmt(STOP)
    bench.application.calls.clear()
    assert bench.put(0x600 + NODE, bytes([0x40, 0, 0x10, 0, 0, 0, 0, 0])) == []
    assert bench.sync() == []
    assert bench.put(0x200 + NODE, bytes(6)) == []
    assert bench.application.calls == []


def test_stopping_ends_a_transfer() -> None:
    bench = operational()
    index = NOTE.to_bytes(2, "little")
    assert bench.request(b"\x21" + index + b"\x00\x0a\x00\x00\x00")[0] == 0x60
    bench.nmt(STOP)
    bench.nmt(START)
    assert bench.request(bytes(8))[4:] == (0x05040001).to_bytes(4, "little")


def test_pdos_live_in_operational_only() -> None:
    bench = Bench()
    assert bench.sync() == []
    assert bench.put(0x200 + NODE, bytes(6)) == []
    assert bench.read(LEVEL) == 7
    bench.nmt(START)
    assert [frame.can_id for frame in bench.sync()] == [0x180 + NODE]
    bench.nmt(PRE_OPERATIONAL)
    assert bench.sync() == []


def test_sync_reaches_the_application_in_pre_operational() -> None:
    bench = Bench()
    bench.sync()
    assert bench.application.calls[-1] == ("sync", 0, 0)


def test_extended_frames_are_not_meant() -> None:
    bench = Bench()
    assert bench.device.receive(Frame(0x000, b"\x01\x00", extended=True), bench.now) == ()
    assert bench.device.state is NmtState.PRE_OPERATIONAL
