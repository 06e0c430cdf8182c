"""The bus contract over serial: each participant an SLCAN adapter of its own, on one hub."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.slcan import SlcanBus
from servobench.drivers.wire.slcan_protocol import SlcanStatus
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.instruments.serial_line import LineFaults
from tests.contract.bus_suite import PATIENCE_S, SILENCE_S, OpenBus, content, data_message
from tests.contract.slcan_bench import RunningAdapter, SlcanSuite
from tests.ports import fetched

pytestmark = pytest.mark.xdist_group("real time")


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hub")


@pytest.fixture
def adapters(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[RunningAdapter]]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    running: list[RunningAdapter] = []
    yield running
    for adapter in running:
        adapter.close()


class TestSlcan(SlcanSuite):
    """The house's own bus class for SLCAN, through pseudo-terminals and the hub."""

    @pytest.fixture
    def open_bus(self, adapters: list[RunningAdapter]) -> Iterator[OpenBus]:
        opened: list[can.BusABC] = []

        def open_one(**options: Any) -> can.BusABC:
            adapter = RunningAdapter("hub:slcan-contract")
            adapters.append(adapter)
            bus = SlcanBus(adapter.port, **options)
            opened.append(bus)
            return bus

        yield open_one
        for bus in opened:
            bus.shutdown()

    def test_lean_path_carries_the_same_frames(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        frame = Frame(0x12345, b"\x07\x08", True)
        sender.frame_port.transmit(frame)  # type: ignore[attr-defined]
        message = receiver.recv(PATIENCE_S)
        assert content(message) == frame
        assert message is not None
        receiver.frame_port.transmit(Frame(0x123, b"", False, True, 4))  # type: ignore[attr-defined]
        got = fetched(sender, Instant(round((message.timestamp + PATIENCE_S) * 1e9)))
        assert got is not None
        received, at = got
        assert received == Frame(0x123, b"", False, True, 4)
        assert at >= message.timestamp * 1e9

    def test_bus_that_was_shut_down_says_so(self, open_bus: OpenBus) -> None:
        bus = open_bus()
        bus.shutdown()
        with pytest.raises(can.CanOperationError, match="shut down"):
            bus.send(data_message(0x100))
        with pytest.raises(can.CanOperationError, match="shut down"):
            bus.recv(0)


def test_a_full_adapter_and_its_flags_are_told(adapters: list[RunningAdapter]) -> None:
    adapter = RunningAdapter("hub:slcan-full", faults=LineFaults(refuse=0.5, status=0x20), seed=1)
    adapters.append(adapter)
    with SlcanBus(adapter.port) as bus, HubBus("slcan-full") as hub:
        for number in range(40):
            bus.send(data_message(number))
            assert bus.recv(0) is None
        flags = bus.status()
        assert flags & SlcanStatus.ERROR_PASSIVE
        came = 0
        while hub.recv(0.2 if came else PATIENCE_S) is not None:
            came += 1
        assert 5 < bus.refused_frames < 35
        assert came == 40 - bus.refused_frames


def test_unplugging_at_a_set_time(adapters: list[RunningAdapter]) -> None:
    adapter = RunningAdapter("hub:slcan-unplug", faults=LineFaults(unplug_after_s=2.0))
    adapters.append(adapter)
    bus = SlcanBus(adapter.port)
    with pytest.raises(can.CanOperationError, match="the adapter was unplugged"):
        bus.recv(10.0)
    bus.shutdown()


def test_python_cans_own_slcan_interface_works_on_the_emulated_adapter(
    adapters: list[RunningAdapter],
) -> None:
    """What anybody else's program would open."""
    adapter = RunningAdapter("hub:slcan-foreign")
    adapters.append(adapter)
    with (
        can.Bus(
            interface="slcan",
            channel=f"{adapter.port}@115200",
            bitrate=1_000_000,
            sleep_after_open=0,
            ignore_config=True,
        ) as foreign,
        HubBus("slcan-foreign") as hub,
    ):
        assert foreign.get_version(1.0) == (10, 13)  # type: ignore[attr-defined]
        assert foreign.get_serial_number(1.0) == "NSB01"[1:]  # type: ignore[attr-defined]
        foreign.send(data_message(0x123, b"\x01\x02"))
        assert content(hub.recv(PATIENCE_S)) == Frame(0x123, b"\x01\x02")
        hub.send(data_message(0x321, b"\x03"))
        assert content(foreign.recv(PATIENCE_S)) == Frame(0x321, b"\x03")
        assert foreign.recv(SILENCE_S) is None
