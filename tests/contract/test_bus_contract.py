"""The bus contract, that of echoes too, on the simulated segment and on the hub."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import can
import pytest

from servobench.drivers.timebase import Clock, MonotonicClock
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.faults.faulty_bus import FaultyBus
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.contract.bus_suite import ExactBusSuite, OpenBus
from tests.contract.echo_suite import EchoSuite

pytestmark = pytest.mark.xdist_group("real time")


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory for the hub of this module's tests, so that they share one broker."""
    return tmp_path_factory.mktemp("hub")


class InFront(FaultyBus):
    """The faults of a bus that is not simulated."""


class TestSimulated(ExactBusSuite, EchoSuite):
    """All participants on one segment, in simulated time."""

    basis = EchoBasis.BUS
    tells_which = True

    @pytest.fixture
    def timeline(self) -> Timeline:
        return Timeline()

    @pytest.fixture
    def clock(self, timeline: Timeline) -> Clock:
        return SimulatedClock(timeline)

    @pytest.fixture(params=[FaultyBus, InFront], ids=["at_the_port", "in_front"])
    def make_faulty(self, request: pytest.FixtureRequest) -> type[FaultyBus]:
        chosen: type[FaultyBus] = request.param
        return chosen

    @pytest.fixture
    def open_bus(self, timeline: Timeline) -> Iterator[OpenBus]:
        segment = CanSegment(timeline, self.bitrate_bit_s)
        opened: list[can.BusABC] = []
        numbers = count()

        def open_one(**options: Any) -> can.BusABC:
            bus = can.Bus(
                interface="simulated",
                channel=f"port{next(numbers)}",
                segment=segment,
                ignore_config=True,
                **options,
            )
            opened.append(bus)
            return bus

        yield open_one
        for bus in opened:
            bus.shutdown()


class TestHub(ExactBusSuite, EchoSuite):
    """All participants on one hub; they share this process but not the broker's."""

    basis = EchoBasis.BUS
    tells_which = True

    @pytest.fixture
    def clock(self) -> Clock:
        return MonotonicClock()

    @pytest.fixture(params=[False, True], ids=["one_by_one", "batches"])
    def batches(self, request: pytest.FixtureRequest) -> bool:
        return bool(request.param)

    @pytest.fixture
    def open_bus(self, runtime: Path, monkeypatch: pytest.MonkeyPatch, batches: bool) -> Iterator[OpenBus]:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
        opened: list[can.BusABC] = []

        def open_one(**options: Any) -> can.BusABC:
            bus = can.Bus(
                interface="hub",
                channel="contract",
                bitrate=self.bitrate_bit_s,
                batches=batches,
                ignore_config=True,
                **options,
            )
            opened.append(bus)
            return bus

        yield open_one
        for bus in opened:
            bus.shutdown()
