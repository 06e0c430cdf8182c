"""Commissioning in real time, over a serial adapter that is on the hub; on vcan it is in tests/vcan."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.scenario.commission_suite import SEED, CommissionSuite, unknown_drive
from tests.scenario.processes import hub_name, run, run_command
from tests.scenario.serial_processes import adapter_process
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")


class TestOverSerial(CommissionSuite):
    """The host has an emulated SLCAN adapter on a pty, the drive is on the hub behind it.

    Units, turn and a proof of the stop are half a minute; tests/vcan has the others too.
    """

    ended_at = "Inertia and friction"

    @pytest.fixture
    def drive_spec(self) -> str:
        return hub_name("commission-serial")

    @pytest.fixture
    def bus_spec(self, drive_spec: str) -> Iterator[str]:
        with adapter_process(drive_spec) as adapter:
            yield adapter.bus


def test_a_bench_runs_with_the_files_that_it_leaves(tmp_path: Path) -> None:
    """The files are those of a rehearsal in simulated time: the drive of a seed is the same everywhere."""
    out, bus = tmp_path / "out", hub_name("commissioned")
    rehearsal = [*hil(), "commission", "--bus", "simulated", "--node", "1", "--rehearse", str(SEED), "--yes"]
    options = ["--out", str(out), "--period-us", "10000", "--heartbeat-timeout-ms", "1500"]
    done = run_command([*rehearsal, *options])
    assert done.returncode == 0, done.stderr
    with unknown_drive(bus, tmp_path):
        code, summary, said = run(out / "bench.toml", bus, tmp_path / "run")
    assert code == 0, said
    assert summary["cycles"] > 250
    # A wrong sign would run away, a wrong unit would be off by half of the speed and more: 67 rad/s.
    assert summary["speed_error"]["rms_rad_s"] < 15.0
