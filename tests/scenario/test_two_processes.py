"""``hil run`` and ``hil simulate`` as two processes on the hub."""

from pathlib import Path

import pytest

from servobench.hil.pytest_plugin import StartDrive
from tests.scenario.processes import EXAMPLES, changed_bench, run
from tests.scenario.two_process_suite import CYCLES, TwoProcesses

pytestmark = pytest.mark.xdist_group("real time")


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is looked at."""


@pytest.mark.servo_bus("hub")
class TestOnHub(TwoProcesses):
    """On a hub of its own, so that no other test's frames are heard."""

    def test_a_controller_of_one_s_own_runs_with_a_solver_in_every_cycle(
        self, servo_bus: str, servo_process: StartDrive, tmp_path: Path
    ) -> None:
        servo_process(1)
        mpc = EXAMPLES / "own_controller" / "mpc.toml"
        _, summary, messages = run(mpc, servo_bus, tmp_path / "run")
        assert summary["verdict"]["completed"] is True, messages
        assert summary["cycles"] == CYCLES
        assert 0.0 < summary["compute_us"]["p50"] <= summary["compute_us"]["max"]
        assert (tmp_path / "run" / "axis1-controller.py").read_text() == mpc.with_suffix(".py").read_text()

    def test_a_run_leaves_the_drive_as_it_found_it(
        self, servo_bus: str, servo_process: StartDrive, tmp_path: Path
    ) -> None:
        """The load torque included: a second run of the same file starts from rest and passes too."""
        servo_process(1)
        bench = changed_bench(tmp_path)
        runs = [run(bench, servo_bus, tmp_path / name) for name in ("first", "second")]

        assert [status for status, _, _ in runs] == [0, 0], [
            (summary.get("verdict"), messages) for _, summary, messages in runs
        ]

    def test_without_a_drive_the_run_ends_with_a_short_error(self, servo_bus: str, tmp_path: Path) -> None:
        bench = changed_bench(tmp_path, connect_timeout_s=1.0)
        status, summary, messages = run(bench, servo_bus, tmp_path / "run")

        assert status == 3
        assert summary["verdict"]["exit_status"] == 3
        assert "node 1" in summary["verdict"]["reason"]
        assert summary["cycles"] == 0
        assert "node 1" in messages
        assert "Traceback" not in messages
