"""What is forked cannot be told from what is started, but by the processes that are its files."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.scenario.processes import EXAMPLES, HIL, quiet_environment, run_command
from tests.warm.start import hil, python

LIMIT_S = 60.0
ROOT = Path(__file__).parents[2]


def environment(**more: str) -> dict[str, str]:
    """In which a started interpreter, too, finds ``tests`` from any folder."""
    return {**quiet_environment(), "PYTHONPATH": str(ROOT), **more}


def report(interpreter: str, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run tests.warm.report to its end."""
    command = [interpreter, "-P", "-m", "tests.warm.report", *arguments]
    options = {"env": environment(), "input": "a line\n", **options}
    return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False, **options)


def found(*arguments: str, **options: Any) -> Iterator[tuple[Any, int, int, str]]:
    """What a process of each way has found, its parent, its status and its standard error."""
    for way in (sys.executable, python()):
        done = report(way, *arguments, **options)
        told = json.loads(done.stdout)
        yield told, told.pop("parent"), done.returncode, done.stderr


def ignore_some() -> None:
    """As nohup does, and a shell for what it leaves in the background."""
    for number in (signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


@pytest.mark.parametrize("status", [0, 3, -signal.SIGTERM, -signal.SIGKILL, -signal.SIGABRT])
def test_a_forked_program_finds_what_a_started_one_finds_and_ends_as_it(status: int, tmp_path: Path) -> None:
    ends = os.pipe()
    env = environment(COLUMNS="33", XDG_RUNTIME_DIR=str(tmp_path), _RJEM_MALLOC_CONF="dirty_decay_ms:1")
    (started, here, *end), (forked, server, *forked_end) = found(
        str(status), "\u00e4 b", "", cwd=tmp_path, env=env, pass_fds=ends, preexec_fn=ignore_some
    )
    for each in ends:
        os.close(each)
    assert here == os.getpid() != server
    assert started == forked
    assert end == forked_end == [status, "on stderr\n"]
    assert {*ends} < {*forked["descriptors"]}
    assert forked["threads"] == 1
    assert forked["handlers"][str(int(signal.SIGHUP))] == str(int(signal.SIG_IGN))


@pytest.mark.parametrize(
    "more",
    [{"LC_TIME": "C"}, {"PYTHONPATH": f"{ROOT}:/nowhere"}, {"PYTHONHASHSEED": "1"}, {"SERVOBENCH_PURE": "1"}],
)
def test_an_environment_that_imports_may_look_at_gets_a_process_of_its_own(more: dict[str, str]) -> None:
    assert [parent for _, parent, *_ in found("0", env=environment(**more))] == [os.getpid()] * 2


def waiting() -> subprocess.Popen[str]:
    """A forked program that waits for its input to end."""
    command = [python(), "-P", "-m", "tests.warm.report", "0"]
    options: dict[str, Any] = {"env": environment(), "text": True}
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, **options)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_the_front_ends_the_program(number: signal.Signals) -> None:
    """Its output ends when the last process that has it is gone."""
    with waiting() as process:
        process.send_signal(number)
        assert process.stdout is not None
        assert process.stdout.read() == ""
        assert process.wait(LIMIT_S) == -number


def test_a_forked_run_records_what_a_started_one_records(tmp_path: Path) -> None:
    digests, files = [], []
    for way, command in {"started": HIL, "forked": hil()}.items():
        asked = [*command, "run", str(EXAMPLES / "ling2012.toml"), "--record", str(tmp_path / way), "--json"]
        done = run_command(asked, tmp_path)
        assert done.returncode == 0, done.stderr
        digests.append(json.loads(done.stdout)["digest"])
        files.append({path.name for path in (tmp_path / way).iterdir()})
        assert run_command([*hil(), "review", str(tmp_path / way)]).returncode == 0
    assert digests[0] == digests[1]
    assert files[0] == files[1]
