"""The bus's own cyclic sender as the producer of SYNC: for how long, and where there is none."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import can
import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.segments import check_sync_source, kernel_sync
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.timeline import Timeline
from tests.unit.hil.test_config import BENCH, edited, load

PERIOD = Duration(NS_PER_MS)


class Rig:
    """A simulated bus, and when SYNCs ended on it."""

    def __init__(self) -> None:
        self.timeline = Timeline()
        segment = CanSegment(self.timeline, 1_000_000)
        self.bus = SimulatedBus(segment=segment)
        self.ends: list[Instant] = []
        segment.add_monitor(lambda frame, at: self.ends.append(at) if frame.can_id == 0x080 else None)

    def pass_time(self, periods: int) -> None:
        self.timeline.run_until(Instant(self.timeline.now + periods * PERIOD))


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.bus.shutdown()


def test_syncs_come_at_the_period_until_it_is_left(rig: Rig) -> None:
    with kernel_sync(rig.bus, PERIOD):
        rig.pass_time(10)
    made = len(rig.ends)
    rig.pass_time(10)
    assert made in (10, 11)
    assert len(rig.ends) - made <= 1, "one that was on its way"
    assert {later - earlier for earlier, later in pairwise(rig.ends)} == {PERIOD}


def test_an_error_ends_them_too(rig: Rig) -> None:
    with pytest.raises(ValueError, match="the run failed"), kernel_sync(rig.bus, PERIOD):
        raise ValueError("the run failed")
    rig.pass_time(10)
    assert len(rig.ends) <= 1


class Refusing(SimulatedBus):
    """A bus without a cyclic sender, as one in real time behind faults."""

    def _send_periodic_internal(self, *_args: Any, **_kwargs: Any) -> Any:
        raise NotImplementedError("used by one thread")


def test_a_bus_that_cannot_is_named() -> None:
    with (
        Refusing(segment=CanSegment(Timeline(), 1_000_000)) as bus,
        pytest.raises(BusDown, match="used by one thread"),
        kernel_sync(bus, PERIOD),
    ):
        pass


def test_a_bus_that_went_away_does_not_hide_why_the_run_ended(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_task: object) -> None:
        raise can.CanOperationError("network is down")

    with monkeypatch.context() as failing:
        failing.setattr("servobench.virtual_bus.bus.simulated_bus.TimelineCyclicTask.stop", fail)
        with pytest.raises(ValueError, match="why"), kernel_sync(rig.bus, PERIOD):
            raise ValueError("why")


@pytest.mark.parametrize("spec", ["simulated", "socketcan:can0"])
def test_the_kernel_makes_syncs_where_it_can(spec: str) -> None:
    check_sync_source(load(edited("loop", "sync", value="kernel")), parse_bus_spec(spec))


@pytest.mark.parametrize("spec", ["hub:a", "pcan:PCAN_USBBUS1", "slcan:/dev/ttyACM0"])
def test_elsewhere_it_is_refused(spec: str) -> None:
    config = load(edited("loop", "sync", value="kernel"))
    with pytest.raises(BadInput, match="'own' or 'foreign' on the bus"):
        check_sync_source(config, parse_bus_spec(spec))
    check_sync_source(load(edited("loop", "sync", value="foreign")), parse_bus_spec(spec))


def test_own_syncs_are_made_everywhere() -> None:
    check_sync_source(load_bench(BENCH), parse_bus_spec("hub:a"))
