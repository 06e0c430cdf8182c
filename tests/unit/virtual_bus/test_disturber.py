"""Which attempts to send are disturbed on the wire."""

from typing import Literal

import pytest
from scipy import stats

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.frame_image import frame_bits
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_injector import Disturber, disturber
from servobench.virtual_bus.faults.fault_log import FaultLog
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.corruption import Corruption
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.fates import keys
from tests.hearing import Hearing

TPDO = Frame(0x181, bytes(8))


def made(*faults: Corruption | Loss, log: FaultLog | None = None, seed: int = 2) -> Disturber:
    found = disturber(FaultPlan(faults), seed, log, lambda name: name == "host")
    assert found is not None
    found.start(Instant(0))
    return found


def test_attempts_are_disturbed_with_their_probability_at_any_bit() -> None:
    source = made(Corruption(probability=0.05))
    count = 20_000
    struck = [source.disturb("drive", TPDO, Instant(k)) for k in range(count)]
    bits = [disturbance.bit for disturbance in struck if disturbance is not None]
    low, high = stats.binomtest(len(bits), count, 0.05).proportion_ci(0.99)
    assert low < 0.05 < high
    length = frame_bits(TPDO)
    assert min(bits) >= 0
    assert max(bits) < length
    assert stats.kstest([(bit + 0.5) / length for bit in bits], "uniform").pvalue > 0.01


def test_a_selection_and_a_window_hold_on_the_wire_too() -> None:
    chosen = keys(direction="host_to_drive", frames=("sync",), until_s=1e-9 * 100)
    source = made(Corruption(probability=1.0, **chosen))
    sync = Frame(0x80)
    assert source.disturb("host", sync, Instant(0)) is not None
    assert source.disturb("drive", sync, Instant(0)) is None
    assert source.disturb("host", TPDO, Instant(0)) is None
    assert source.disturb("host", sync, Instant(100)) is None
    assert source.disturbed == {"host_to_drive": 1, "drive_to_host": 0}


def test_nothing_is_disturbed_before_the_start_and_after_the_end() -> None:
    source = made(Corruption(probability=1.0))
    source.stop()
    assert source.disturb("drive", TPDO, Instant(0)) is None
    source.start(Instant(5))
    assert source.disturb("drive", TPDO, Instant(5)) is not None


@pytest.mark.parametrize("effect", ["lost", "data"])
def test_only_error_frames_are_made_on_the_wire(effect: Literal["lost", "data", "error_frame"]) -> None:
    plan = FaultPlan((Corruption(probability=1.0, effect=effect), Loss(probability=1.0)))
    assert disturber(plan, 1, None, bool) is None
    assert disturber(RecordedFaults(), 1, None, bool) is None


def test_a_replay_disturbs_the_same_attempts() -> None:
    log = FaultLog()
    source = made(Corruption(probability=0.2), log=log)
    frames = [Frame(0x181 + k % 3, bytes(k % 9)) for k in range(300)]
    first = [source.disturb("drive", frame, Instant(k)) for k, frame in enumerate(frames)]
    again = disturber(RecordedFaults(tuple(log.entries())), 9, None, lambda name: name == "host")
    assert again is not None
    again.start(Instant(1000))
    assert [again.disturb("drive", frame, Instant(1000 + 7 * k)) for k, frame in enumerate(frames)] == first
    assert any(disturbance is not None for disturbance in first)


def test_a_disturbed_frame_is_repeated_until_it_comes_through() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    got: list[tuple[Frame, Instant]] = []
    sender = segment.attach("drive", Listener())
    segment.attach("host", Hearing(lambda frame, at: got.append((frame, at))))
    window = keys(until_s=1e-9 * 1_000_000)
    source = made(Corruption(probability=1.0, **window))
    segment.set_disturb(source.disturb)
    sender.send(TPDO)
    timeline.run_until(Instant(5_000_000))
    ((frame, at),) = got
    assert frame == TPDO
    assert at > 1_000_000
    assert segment.errors == source.disturbed["drive_to_host"] >= 5
