"""Whole runs at SYNCs that the loop does not make: another node's, or those of the bus's cyclic sender."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BadInput, DriveInFault, NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Instant
from servobench.hil.execution import world
from servobench.hil.rows.records import Rows
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.virtual_bus.device.background import BackgroundNode, Stream, background_nodes
from tests.scenario.processes import BENCH, EXAMPLES

LING2012 = EXAMPLES / "ling2012.toml"
SHORT = {"bench.duration_s": 1.0, "load": {}, "verdict": {"missed_percent_max": 2.0}}
STALLS = {"host_stall": [{"every_s": 0.0473, "late_min_us": 100, "late_max_us": 400}]}


def produced(period_us: int = 1000, jitter_us: int = 0) -> dict[str, Any]:
    """Changes of a bench: another node makes the SYNC."""
    sync = {"can_id": 0x080, "bytes_max": 0, "period_us": period_us, "jitter_us": jitter_us}
    return {**SHORT, "loop.sync": "foreign", "bus": {"background": [sync]}}


def spacing_ns(rows: Rows) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Between the SYNCs on the bus."""
    return np.diff(rows["sync_on_bus_at"])


@pytest.mark.parametrize("changes", [{**SHORT, "loop.sync": "kernel"}, produced(), produced(1001, 200)])
def test_the_cycles_follow_the_syncs(servo_bench: BenchRunner, changes: Mapping[str, Any]) -> None:
    run = servo_bench(LING2012, changes, faults={})
    run.assert_passed()
    run.assert_no_unintended_frame()
    rows = run.rows
    assert run.summary.cycles == rows.size == 1000
    assert run.summary.dropouts.total == 0
    assert (rows["due_at"] == rows["sync_on_bus_at"]).all()
    assert (rows["sampled_at"] == rows["due_at"]).all()
    assert not run.wire.find("080#", sent=True), "none sent by the loop"


def test_a_late_host_does_not_shift_the_syncs(servo_bench: BenchRunner) -> None:
    own = servo_bench(LING2012, {**SHORT, "loop.sync": "own"}, faults=STALLS)
    kernel = servo_bench(LING2012, {**SHORT, "loop.sync": "kernel"}, faults=STALLS)
    for run in (own, kernel):
        assert 300.0 < np.max(run.rows["woke_at"] - run.rows["due_at"]) / NS_PER_US < 500.0
    assert np.ptp(spacing_ns(own.rows)) > 300_000
    assert np.ptp(spacing_ns(kernel.rows)) < 140_000, "a frame of the drive at most, in front of it"


class Stopping(BackgroundNode):
    """A producer that ends after a second and a half, in the middle of the run."""

    def wake(self, now: Instant) -> Sequence[Any]:
        if now > 1.5 * NS_PER_S:
            self.wake_at = None
        return super().wake(now)


def test_a_producer_that_stops_ends_the_run_with_the_drive_at_rest(
    servo_bench: BenchRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopping(streams: Sequence[Stream], seed: int) -> list[BackgroundNode]:
        return [Stopping(node.stream, seed, "0") for node in background_nodes(streams, seed)]

    monkeypatch.setattr(world, "background_nodes", stopping)
    run = servo_bench(LING2012, {**produced(), "bench.duration_s": 3.0}, faults={}, ends_in=DriveInFault)
    assert "8250h (RPDO time-out)" in str(run.error)
    assert 0 < run.summary.cycles < 1500
    states = [event["state"] for event in run.events if event.get("track") == "axis1 drive"]
    assert states[-1].lower() == State.SWITCH_ON_DISABLED.value
    assert not [event for event in run.events if "not confirmed at rest" in str(event)]


def test_another_period_is_refused_before_the_drive_is_enabled(servo_bench: BenchRunner) -> None:
    run = servo_bench(LING2012, produced(1024), faults={}, ends_in=PeerFault)
    assert "SYNC comes every 1024.0 us, and loop.period_us is 1000" in str(run.error)
    with pytest.raises(AssertionError):
        run.assert_reached(State.OPERATION_ENABLED)


def test_a_silent_producer_is_named(servo_bench: BenchRunner) -> None:
    run = servo_bench(LING2012, produced(1_000_000_000), faults={}, ends_in=NoAnswer)
    assert "no SYNC was heard" in str(run.error)
    assert "COB-ID 080h" in str(run.error)


def test_another_masters_syncs_beside_the_own_are_counted(
    servo_bench: BenchRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Stream(0x080, period=19_000_000, bytes_min=0, bytes_max=0)  # type: ignore[arg-type]
    monkeypatch.setattr(world, "background_nodes", lambda _streams, seed: background_nodes([other], seed))
    run = servo_bench(LING2012, {**SHORT, "loop.sync": "own"}, faults={})
    assert run.summary.timing is not None
    assert 50 <= run.summary.timing["sync"]["simulated"]["surplus"] <= 60


def test_where_nobody_can_make_the_sync_the_bench_is_refused(servo_bench: BenchRunner) -> None:
    with pytest.raises(BadInput, match=r"loop\.sync: found 'foreign'.*\[\[bus\.background\]\]"):
        servo_bench(LING2012, {"loop.sync": "foreign"})


@pytest.mark.servo_bus("hub")
@pytest.mark.xdist_group("real time")
def test_a_hub_has_no_cyclic_sender(servo_bench: BenchRunner) -> None:
    with pytest.raises(
        BadInput, match=r"loop\.sync: found 'kernel', expected 'own' or 'foreign' on the bus hub:"
    ):
        servo_bench(BENCH, {"loop.sync": "kernel"})
