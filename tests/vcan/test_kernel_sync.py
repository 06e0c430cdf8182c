"""Runs at SYNCs of the kernel's broadcast manager, made for the bench or for another node."""

import can
import pytest

from servobench.drivers.errors import LimitExceeded
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.scenario.processes import BENCH
from tests.vcan.late_machine import AT_LEISURE, PERIOD_US

pytestmark = pytest.mark.servo_bus("vcan")

PERIOD_S = PERIOD_US / 1e6
SILENT_S = 20 * PERIOD_S


def assert_cycles_are_syncs(run: Run) -> None:
    run.assert_no_unintended_frame()
    rows = run.rows[run.rows["sync_on_bus_at"] >= 0]
    assert rows.size > 0.5 * run.summary.cycles > 100
    assert (rows["due_at"] == rows["sync_on_bus_at"]).all()
    assert len(run.wire.find("080#", sent=False)) > rows.size
    assert not run.wire.find("080#", sent=True), "none was sent by the loop"


def is_silent(channel: str) -> bool:
    """Whether there is no SYNC on the bus."""
    with can.Bus(
        interface="socketcan", channel=channel, can_filters=[{"can_id": 0x080, "can_mask": 0x7FF}]
    ) as bus:
        return bus.recv(SILENT_S) is None


def test_the_kernels_syncs_drive_a_run_and_end_with_it(servo_bench: BenchRunner, channel: str) -> None:
    run = servo_bench(BENCH, {"loop.sync": "kernel"} | AT_LEISURE)
    run.assert_passed()
    assert_cycles_are_syncs(run)
    assert is_silent(channel)


def test_they_end_with_a_run_that_fails(servo_bench: BenchRunner, channel: str) -> None:
    servo_bench(
        BENCH,
        {
            "loop.sync": "kernel",
            "drive.axis1.limits.speed_max_rpm": 1000.5,
            "load.axis1": [{"at_s": 1.5, "torque_nm": -0.4}],
        },
        ends_in=LimitExceeded,
    )
    assert is_silent(channel)


def test_another_nodes_syncs_drive_a_run(servo_bench: BenchRunner, channel: str) -> None:
    message = can.Message(arbitration_id=0x080, is_extended_id=False)
    with can.Bus(interface="socketcan", channel=channel) as other:
        task = other.send_periodic(message, PERIOD_S)
        run = servo_bench(BENCH, {"loop.sync": "foreign"} | AT_LEISURE)
        task.stop()
    run.assert_passed()
    assert_cycles_are_syncs(run)
