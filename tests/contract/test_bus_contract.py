"""The bus contract on the simulated segment and on the hub."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import can
import pytest

from tests.contract.bus_suite import ExactBusSuite, OpenBus
from virtual_bus.segment import Segment
from virtual_bus.timeline import Timeline

pytestmark = pytest.mark.xdist_group("real time")


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory for the hub of this module's tests, so that they share one broker."""
    return tmp_path_factory.mktemp("hub")


class TestSimulated(ExactBusSuite):
    """All participants on one segment, in simulated time."""

    @pytest.fixture
    def open_bus(self) -> Iterator[OpenBus]:
        segment = Segment(Timeline(), self.bitrate_bit_s)
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


class TestHub(ExactBusSuite):
    """All participants on one hub; they share this process but not the broker's."""

    @pytest.fixture
    def open_bus(self, runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[OpenBus]:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
        opened: list[can.BusABC] = []

        def open_one(**options: Any) -> can.BusABC:
            bus = can.Bus(
                interface="hub",
                channel="contract",
                bitrate=self.bitrate_bit_s,
                ignore_config=True,
                **options,
            )
            opened.append(bus)
            return bus

        yield open_one
        for bus in opened:
            bus.shutdown()
