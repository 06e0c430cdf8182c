"""The bit rate of a running bus, found through an adapter that only listens."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import NS_PER_MS, Duration, MonotonicClock
from servobench.drivers.wire.adapters import BusSpec
from servobench.drivers.wire.attached import detect_bitrate
from servobench.drivers.wire.slcan import SlcanBus
from servobench.drivers.wire.slcan_protocol import SlcanStatus
from servobench.virtual_bus.bus.hub import HubBus
from tests.contract.slcan_bench import running_adapter

pytestmark = pytest.mark.xdist_group("real time")

CLOCK = MonotonicClock()
LISTEN = Duration(150 * NS_PER_MS)


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@contextmanager
def traffic(hub: str, bitrate_bit_s: int) -> Iterator[HubBus]:
    """A heartbeat each 10 ms."""
    with HubBus(hub, bitrate=bitrate_bit_s) as bus:
        over = threading.Event()

        def send() -> None:
            while not over.wait(0.01):
                bus.send(can.Message(arbitration_id=0x701, is_extended_id=False, data=b"\x7f"))

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        try:
            with HubBus(hub) as listener:
                assert listener.recv(5.0) is not None, "the hub does not get going"
            yield bus
        finally:
            over.set()
            thread.join(5.0)


def test_the_rate_of_a_running_bus_is_found_and_nothing_is_sent() -> None:
    with traffic("rate", 250_000) as other, running_adapter("hub:rate") as adapter:
        before = other.status()
        spec = BusSpec("slcan", adapter.port)
        found = detect_bitrate(spec, CLOCK, listen=LISTEN)
        assert found.bitrate_bit_s == 250_000
        assert [trial.bitrate_bit_s for trial in found.trials] == [1_000_000, 500_000, 250_000]
        assert all(trial.frames == 0 for trial in found.trials[:-1])
        assert adapter.server.adapter.frames_sent == 0
        assert other.status().transmit_errors == before.transmit_errors == 0
        # the adapter takes part at the rate that was found
        with SlcanBus(adapter.port, bitrate=found.bitrate_bit_s) as bus:
            assert bus.recv(2.0) is not None


def test_a_silent_bus_tells_nothing() -> None:
    with running_adapter("hub:silent", 500_000) as adapter:
        found = detect_bitrate(
            BusSpec("slcan", adapter.port),
            CLOCK,
            candidates=(1_000_000, 500_000),
            listen=Duration(20 * NS_PER_MS),
        )
        assert found.bitrate_bit_s is None
        assert found.silent


def test_a_bus_at_none_of_the_rates_is_told_from_a_silent_one() -> None:
    with traffic("odd", 250_000), running_adapter("hub:odd") as adapter:
        spec = BusSpec("slcan", adapter.port)
        found = detect_bitrate(spec, CLOCK, candidates=(1_000_000,), listen=LISTEN)
        assert found.bitrate_bit_s is None
        assert not found.silent


def test_an_adapter_at_the_wrong_rate_refuses_and_says_why() -> None:
    with traffic("wrong", 250_000), running_adapter("hub:wrong") as adapter:
        bus = SlcanBus(adapter.port, bitrate=1_000_000)

        def keep_sending() -> None:
            for _ in range(400):
                bus.send(can.Message(arbitration_id=0x123, is_extended_id=False))
                bus.recv(0)
            bus.recv(1.0)

        with pytest.raises(can.CanOperationError, match=r"refused \d+ frames.*error passive.*bus error"):
            keep_sending()
        assert bus.adapter_status & SlcanStatus.BUS_ERROR
        bus.shutdown()


def test_adapters_that_cannot_only_listen_are_told() -> None:
    with pytest.raises(BadInput, match=r"can only listen.*--bitrate"):
        detect_bitrate(BusSpec("socketcan", "can0"), CLOCK)
    with pytest.raises(BusDown, match="cannot open slcan:/dev/no-such-port"):
        detect_bitrate(BusSpec("slcan", "/dev/no-such-port"), CLOCK)
