"""A campaign leaves with 0 only behind its last run, whatever its check puts in the way of an exit status."""

import json
import tomllib
from pathlib import Path

import pytest

from servobench.hil.configuration.config_files import toml_text
from tests.draws import few_of
from tests.exits.misused_hooks import __file__ as hooks
from tests.scenario.processes import HIL, run_command
from tests.unit.hil.recorded_runs import BENCH
from tests.warm.start import hil

CODE = """
import signal
import sys
import typer


def later(_signal, _frame):
    raise typer.Exit(0)


def exits_later(seed, run):
    run()
    signal.signal(signal.SIGALRM, later)
    signal.setitimer(signal.ITIMER_REAL, 0.001)
    return ["found"]


def takes_sys_exit(seed, run):
    run()
    sys.exit = lambda status=0: None
    return ["found"]
"""


def sweep(folder: Path, **own: str) -> Path:
    (folder / "own.py").write_text(CODE)
    change = {"bench.duration_s": 0.1, "reference.axis1.0.at_s": 0.0, "load": {}, "faults": {}}
    (path := folder / "sweep.toml").write_text(
        toml_text(
            {
                "campaign": {"name": "exits", "bench": str(BENCH), "seeds": 2, "failures_recorded": 0},
                "change": change,
                "own": own,
            }
        )
    )
    return path


def ended(folder: Path, *before: str, **own: str) -> tuple[int, dict[str, object], str]:
    """``before``: what limits a process, which is none that is forked."""
    command = ["campaign", str(sweep(folder, **own)), "--out", str(folder / "out"), "--workers", "1"]
    done = run_command([*before, *(HIL if before else hil()), *command, "--json"])
    return done.returncode, json.loads(done.stdout), done.stderr


@pytest.mark.parametrize(("check", "status"), [("exits_later", 3), ("takes_sys_exit", 1)])
def test_no_check_makes_a_campaign_leave_with_0(tmp_path: Path, check: str, status: int) -> None:
    """The one raised typer.Exit(0) into the second run, the other made sys.exit() return: 0 both times."""
    returned, told, said = ended(tmp_path, check=f"own.py:{check}")
    assert returned == status, said
    if status == 1:
        assert told["runs"] == 2
    else:
        assert str(told["error"]).startswith("your own code raised outside of its calls: own.py:")
        assert told["exit_status"] == status


def test_a_campaign_for_which_there_is_no_room_says_so(tmp_path: Path) -> None:
    """By a limit on files, as by a full disk."""
    status, told, said = ended(tmp_path, "bash", "-c", 'ulimit -f 1; exec "$@"', "bash")
    assert status == told["exit_status"] == 5, said
    assert told["error"] == f"--out: {tmp_path / 'out'}: File too large"
    assert "Traceback" not in said


@pytest.mark.parametrize("workers", few_of(["2", "1"], 1))
def test_what_a_controller_has_replaced_is_named_wherever_it_ran(tmp_path: Path, workers: str) -> None:
    """A worker died with it, three times, and the campaign ended with 6."""
    path = sweep(tmp_path)
    way = "put('servobench.drivers.canopen.sdo:PumpedSdoClient.upload')"
    controller = {
        "kind": "python",
        "object": f"{hooks}:Hooks",
        "parameters": {"where": "channels", "way": way},
    }
    written = tomllib.loads(path.read_text(encoding="utf-8"))
    del written["own"]
    written["change"]["drive.axis1.controller"] = controller
    path.write_text(toml_text(written), encoding="utf-8")
    command = [*hil(), "campaign", str(path), "--out", str(tmp_path / "out")]
    done = run_command([*command, "--workers", workers, "--json"])
    assert done.returncode == 3, done.stderr
    said = json.loads(done.stdout)["error"]
    assert said.startswith(
        "your own code has replaced servobench.drivers.canopen.sdo.PumpedSdoClient.upload; then"
    )
