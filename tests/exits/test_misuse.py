"""Some of what ``make exits`` runs: the user's code ends in every way, and what is told of it."""

import json
import os
import select
import sys
import termios
from pathlib import Path

import pytest

from servobench.hil.recording.run_metadata import read_summary
from servobench.hil.terminal.run_object import read_back
from servobench.virtual_bus.child_python import python_command
from tests.draws import few_of
from tests.exits.misused_hooks import __file__ as hooks
from tests.scenario.processes import (
    BENCH,
    changed_bench,
    hub_name,
    in_background,
    long_bench,
    observer,
    run_command,
    simulated_drive,
    start_run,
    summary_of,
)
from tests.warm.start import hil

real_time = pytest.mark.xdist_group("real time")
SEED, RUNS = 5, 6


def with_hooks(bench: Path, where: str, way: str) -> Path:
    """A bench file whose controller does ``way``."""
    text = bench.read_text(encoding="utf-8")
    head, _, rest = text.partition("[drive.axis1.controller]")
    _, _, after = rest.partition("\n[")
    parameters = f"{{where = {json.dumps(where)}, way = {json.dumps(way)}}}"
    own = f'[drive.axis1.controller]\nkind = "python"\nobject = "{hooks}:Hooks"\nparameters = {parameters}\n'
    bench.write_text(f"{head}{own}\n[{after}", encoding="utf-8")
    return bench


def test_whatever_the_user_s_code_does_the_command_ends_as_documented() -> None:
    command = [sys.executable, "-m", "tests.exits.misuse", "--runs", str(RUNS), "--seed", str(SEED)]
    done = run_command(command, Path(__file__).parents[2])
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{RUNS} commands ended" in done.stdout


@pytest.mark.parametrize("kind", few_of([pytest.param("hub", marks=real_time), "pytest", "campaign"], 1))
def test_nor_elsewhere_does_it_make_a_run_pass(kind: str) -> None:
    command = [sys.executable, "-m", "tests.exits.elsewhere", kind, "--runs", "2", "--seed", str(SEED)]
    done = run_command(command, Path(__file__).parents[2])
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 runs, " in done.stdout
    assert ", 0 wrong" in done.stdout


@real_time
def test_a_command_that_is_gone_has_its_drive_stopped_and_its_recording_finished(tmp_path: Path) -> None:
    bus = hub_name("gone")
    bench = with_hooks(changed_bench(tmp_path), "output", "print('bye'); ctypes.CDLL(None)._exit(0)")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(bench, bus, tmp_path / "run", by=hil())
        out, said = process.communicate(timeout=60)
        assert watching.time_to_rest(watching.now(), 1.0) >= 0
    assert process.returncode == 6, said
    assert "hil: error: the process of hil run ended itself with status 0" in said
    assert "hil: node 1: at rest and disabled" in said
    assert "printed: bye\n" in said
    assert (tmp_path / "run" / "printed.txt").read_text() == "bye\n"
    told = json.loads(out)
    assert told["verdict"]["exit_status"] == 6
    assert told["digest"] == summary_of(tmp_path / "run")["digest"]


@real_time
def test_a_function_replaced_by_the_user_s_code_is_named_and_the_drive_is_stopped(tmp_path: Path) -> None:
    """Nothing in the process can be relied upon then, the release of its drives neither."""
    bus = hub_name("replaced")
    bench = with_hooks(changed_bench(tmp_path), "output", "put('math:isfinite')")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(bench, bus, tmp_path / "run", by=hil())
        out, said = process.communicate(timeout=60)
        assert watching.time_to_rest(watching.now(), 1.0) >= 0
    assert process.returncode == 3, said
    assert "hil: error: your own code has replaced math.isfinite; then own_code.py:" in said
    assert "hil: node 1: at rest" in said
    assert json.loads(out)["verdict"] == summary_of(tmp_path / "run")["verdict"]


def test_housekeeping_that_is_no_longer_done_holds_up_no_simulated_time(tmp_path: Path) -> None:
    """It stays due, and time went no further."""
    silent = "put('servobench.drivers.canopen.life_signs:LifeSigns.keep', lambda *_, **__: {})"
    bench = with_hooks(changed_bench(tmp_path), "output", silent)
    process = start_run(bench, "simulated", tmp_path / "run", by=hil())
    out, said = process.communicate(timeout=60)
    assert process.returncode in (3, 6), said
    assert not json.loads(out)["verdict"]["passed"]


def test_a_terminal_that_is_stopped_holds_no_run_up(tmp_path: Path) -> None:
    """Ctrl-S, from its start until all is recorded; a controller that says more than the terminal takes."""
    keyboard, terminal = os.openpty()
    termios.tcflow(terminal, termios.TCOOFF)
    try:
        bench = with_hooks(changed_bench(tmp_path), "output", "overflow()")
        command = ["run", str(bench), "--bus", "simulated", "--record", str(tmp_path / "run"), "--json"]
        process = in_background([*hil(), *command], stderr=terminal)
        summary = summary_of(tmp_path / "run")
        assert process.poll() is None, "somebody may want to read it"
        termios.tcflow(terminal, termios.TCOON)
        while process.poll() is None:
            if select.select([keyboard], [], [], 0.1)[0]:
                os.read(keyboard, 1 << 16)
        out, _ = process.communicate(timeout=20)
        assert json.loads(out) == summary
        assert process.returncode == summary["verdict"]["exit_status"] != 70
    finally:
        os.close(keyboard)
        os.close(terminal)


def test_a_limit_on_files_is_told_as_one(tmp_path: Path) -> None:
    """It counts for files in memory, too: there is no room for a ring."""
    command = python_command(
        "servobench.hil.cli", "run", str(BENCH), "--bus", "simulated", "--record", str(tmp_path / "run")
    )
    done = run_command(["sh", "-c", 'ulimit -f 64; exec "$@"', "sh", *command, "--json"])
    assert done.returncode == 5, done.stderr
    assert "raise the limit of ulimit -f" in done.stderr
    verdict = json.loads(done.stdout)["verdict"]
    assert (verdict["outcome"], verdict["exit_status"]) == ("not recorded", 5)


@real_time
def test_a_terminal_that_is_closed_ends_the_run_at_rest(tmp_path: Path) -> None:
    """The command leads the session of its terminal, as in a window of its own: it alone is told."""
    bus = hub_name("closed")
    keyboard, terminal = os.openpty()
    with simulated_drive(bus), observer(bus) as watching:
        asked = ["run", str(long_bench(tmp_path)), "--bus", bus, "--record", str(tmp_path / "run"), "--json"]
        command = ["setsid", "--ctty", *python_command("servobench.hil.cli", *asked)]
        process = in_background(command, stdin=terminal, stderr=terminal)
        os.close(terminal)
        watching.until_turning(50.0)
        os.close(keyboard)
        out, _ = process.communicate(timeout=30)
        assert watching.time_to_rest(watching.now(), 1.0) >= 0
    assert process.returncode == 130
    verdict = json.loads(out)["verdict"]
    assert (verdict["exit_status"], verdict["reason"]) == (130, "ended by SIGHUP")


def test_a_run_passes_only_with_a_recording_that_holds_its_seal(tmp_path: Path) -> None:
    bench = with_hooks(changed_bench(tmp_path), "output", "pass")
    bench.write_text(bench.read_text(encoding="utf-8").partition("[verdict]")[0], encoding="utf-8")
    asked = ["run", str(bench), "--bus", "simulated", "--record", str(tmp_path / "run")]
    done = run_command([*hil(), *asked])
    summary = read_summary(tmp_path / "run")
    assert done.returncode == summary.verdict.exit_status == 0, done.stderr
    assert read_back(summary) == summary
    with (tmp_path / "run" / "events.jsonl").open("a", encoding="utf-8") as events:
        events.write("\n")
    verdict = read_back(summary).verdict
    assert (verdict.outcome, verdict.exit_status) == ("not recorded", 5)
    assert "events.jsonl" in verdict.reason


def test_a_summary_that_is_another_one_at_the_end_is_no_proof(tmp_path: Path) -> None:
    """The user's code alters it when its process ends, after the run has told what it came to."""
    summary = tmp_path / "run" / "summary.json"
    spoil = f"atexit.register(lambda: os.truncate({str(summary)!r}, 100))"
    bench = with_hooks(changed_bench(tmp_path), "output", spoil)
    bench.write_text(bench.read_text(encoding="utf-8").partition("[verdict]")[0], encoding="utf-8")
    asked = ["run", str(bench), "--bus", "simulated", "--record", str(tmp_path / "run"), "--json"]
    done = run_command([*hil(), *asked])
    verdict = json.loads(done.stdout)["verdict"]
    assert (done.returncode, verdict["exit_status"], verdict["passed"]) == (5, 5, False), done.stderr
    assert "summary.json cannot be read back" in verdict["reason"]


IN_PYTEST = """
def test_one(servo_bench):
    servo_bench({bench!r})


def test_other():
    pass
"""


def test_native_code_that_ends_a_worker_of_pytest_fails_its_test(tmp_path: Path) -> None:
    """Without workers pytest is gone with status 0, and nothing in its process can say so."""
    bench = with_hooks(changed_bench(tmp_path), "output", "ctypes.CDLL(None)._exit(0)")
    (tmp_path / "test_user.py").write_text(IN_PYTEST.format(bench=str(bench)), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "-c", os.devnull, "test_user.py"]
    done = run_command(command, tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "worker 'gw0' crashed while running '::test_one'" in done.stdout
    assert "1 failed, 1 passed" in done.stdout


@pytest.mark.parametrize("where", few_of(["__init__", "output"], 1))
def test_a_standard_stream_that_is_closed_in_pytest_ends_no_test(tmp_path: Path, where: str) -> None:
    """Its number is free when the rings of the recording are made."""
    bench = with_hooks(changed_bench(tmp_path), where, "os.close(0)")
    (tmp_path / "test_user.py").write_text(IN_PYTEST.format(bench=str(bench)), encoding="utf-8")
    done = run_command([sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "test_user.py"], tmp_path)
    assert (done.returncode, "2 passed" in done.stdout) == (0, True), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("where", "way", "said"),
    [
        (
            "channels",
            "put('servobench.drivers.canopen.sdo:PumpedSdoClient.upload')",
            "your own code has replaced servobench.drivers.canopen.sdo.PumpedSdoClient.upload; then ",
        ),
        (
            "channels",
            "put('servobench.drivers.canopen.sdo:PumpedSdoClient.upload'); put('traceback:extract_tb')",
            "your own code has run here, and afterwards the process failed, and failed again",
        ),
        (
            "channels",
            "put('servobench.hil.terminal.commands:explained'); "
            "put('servobench.drivers.canopen.sdo:PumpedSdoClient.upload'); "
            "put('servobench.hil.execution.conclusion:explained')",
            "your own code has run, and afterwards the process could not report what failed",
        ),
        (
            "output",
            "put('servobench.hil.verdict.summary:Summary.as_json', lambda _: {})",
            "your own code has run, and afterwards the process reported an invalid result",
        ),
        (
            "output",  # what stops the drive fails at once, again and again
            "put('servobench.drivers.canopen.sdo:PumpedSdoClient.upload', lambda *_, **__: {})",
            "node 1 sent no data for 6041h:00",
        ),
    ],
)
def test_a_damaged_process_is_no_defect_of_the_program(
    tmp_path: Path, where: str, way: str, said: str
) -> None:
    """Its parent is made of nothing that is in it, and prints an object of its own."""
    bench = with_hooks(changed_bench(tmp_path), where, way)
    asked = ["run", str(bench), "--bus", "simulated", "--no-record", "--json"]
    done = run_command([*hil(), *asked])
    assert done.returncode == 3, done.stderr
    assert f"hil: error: {said}" in done.stderr
    verdict = json.loads(done.stdout)["verdict"]
    assert (verdict["exit_status"], verdict["outcome"]) == (3, "bus, drive or safety")
    assert verdict["reason"].startswith(said)
