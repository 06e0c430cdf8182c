"""The scripts that find a vcan0 for the tests carry out the command's exit status."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UML = ROOT / ".ci" / "uml" / "run"
TEST_VCAN = ROOT / ".ci" / "test-vcan"
TIMEOUT_S = 60

needs_uml = pytest.mark.skipif(shutil.which("linux.uml") is None, reason="User Mode Linux is not installed")


def run(command: Sequence[str | Path], path: str | None = None) -> subprocess.CompletedProcess[str]:
    """The command's end, with both outputs; ``path``: its search path."""
    environment = os.environ if path is None else {**os.environ, "PATH": path}
    return subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


@pytest.fixture
def bare_path(tmp_path: Path) -> str:
    """A search path with the shell's own tools, and neither User Mode Linux nor a way to vcan."""
    for name in ("bash", "env", "dirname", "grep", "find", "sort", "tail", "wc", "awk"):
        found = shutil.which(name)
        assert found is not None
        (tmp_path / name).symlink_to(found)
    return str(tmp_path)


@needs_uml
def test_a_command_runs_here_with_vcan0_up_and_its_status_is_carried_out() -> None:
    script = 'pwd; cat /sys/class/net/vcan0/flags; printf "%s|" "$@"; exit 7'
    done = run([UML, "--memory", "256", "--", "bash", "-c", script, "bash", "two words", "$HOME", "it's"])

    assert done.returncode == 7
    folder, flags, words = done.stdout.splitlines()
    assert folder == str(ROOT)
    assert int(flags, 16) & 1
    assert words == "two words|$HOME|it's|"


@needs_uml
def test_a_command_that_does_not_end_is_stopped() -> None:
    done = run([UML, "--memory", "256", "--timeout", "3", "--", "sleep", "1000"])

    assert done.returncode == 124
    assert "no end after 3 s" in done.stderr


@pytest.mark.parametrize("arguments", [(), ("--memory", "lots", "--", "true"), ("--unknown",)])
def test_misuse_shows_how_it_is_used(arguments: tuple[str, ...]) -> None:
    done = run([UML, *arguments])

    assert done.returncode == 2
    assert "--timeout SECONDS" in done.stderr


def test_without_user_mode_linux_one_line_says_how_to_get_it(bare_path: str) -> None:
    done = run([UML, "true"], bare_path)

    assert done.returncode == 125
    assert "apt-get install user-mode-linux" in done.stderr


def put_program(folder: str, name: str, script: str) -> None:
    """A program that the search path finds first."""
    program = Path(folder, name)
    program.write_text(f"#!/bin/bash\n{script}\n", encoding="utf-8")
    program.chmod(0o755)


def test_without_any_vcan_nothing_is_tested_and_that_is_said(bare_path: str) -> None:
    for name in ("ip", "modprobe"):
        put_program(bare_path, name, "exit 1")
    done = run([TEST_VCAN, "bash", "-c", "echo tested"], bare_path)

    assert done.returncode == 77
    assert done.stdout == ""
    assert "nothing tested" in done.stderr


def test_a_vcan0_that_is_up_is_used_as_it_is(bare_path: str) -> None:
    put_program(bare_path, "ip", 'echo "$@" >>"${0%/*}/calls"; echo "3: vcan0: <NOARP,UP>"')
    done = run([TEST_VCAN, "bash", "-c", 'echo "$SERVOBENCH_VCAN"; exit 5'], bare_path)

    assert done.returncode == 5
    assert done.stdout.splitlines()[-1] == "required"
    assert Path(bare_path, "calls").read_text(encoding="utf-8") == "link show dev vcan0 up\n"


def test_a_vcan0_made_for_the_run_is_removed_after_it(bare_path: str) -> None:
    put_program(bare_path, "modprobe", "exit 0")
    put_program(bare_path, "ip", 'echo "$@" >>"${0%/*}/calls"')
    done = run([TEST_VCAN, "bash", "-c", "exit 5"], bare_path)

    assert done.returncode == 5
    calls = Path(bare_path, "calls").read_text(encoding="utf-8").splitlines()
    assert calls[1:] == ["link add dev vcan0 type vcan", "link set vcan0 up", "link delete vcan0"]
