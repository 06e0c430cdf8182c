"""The witness of the machine, which decides whether a test in real time may be tried again."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from tests.conftest import LEFT_OUT_MAX
from tests.stillness import EXCUSED_MS, STOOD_STILL_MS, Witness

WAITED_MS = 40
PATIENCE_MS = 5_000
CLOCK = MonotonicClock()
ON_EMULATED = {"SERVOBENCH_EMULATED": "1"}


@pytest.fixture
def witness() -> Iterator[Witness]:
    made = Witness()
    yield made
    made.stop()


def rest(milliseconds: int) -> None:
    CLOCK.sleep_until(Instant(CLOCK.now() + milliseconds * NS_PER_MS))


def test_a_process_that_waited_is_told_until_the_next_test_begins(witness: Witness) -> None:
    os.kill(witness.process_id, signal.SIGSTOP)
    rest(WAITED_MS)
    os.kill(witness.process_id, signal.SIGCONT)
    deadline = CLOCK.now() + PATIENCE_MS * NS_PER_MS
    while not witness.late_ms() and CLOCK.now() < deadline:
        rest(1)
    assert witness.late_ms() >= WAITED_MS - EXCUSED_MS
    witness.begin()
    os.kill(witness.process_id, signal.SIGSTOP)  # it cannot tell anything meanwhile
    assert witness.late_ms() == 0
    os.kill(witness.process_id, signal.SIGCONT)


def test_one_that_has_ended_says_so(witness: Witness) -> None:
    os.kill(witness.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, witness.process_id, os.WEXITED | os.WNOWAIT)
    with pytest.raises(AssertionError, match="nobody watches"):
        witness.late_ms()


@pytest.mark.xdist_group("real time")
@pytest.mark.parametrize(
    ("late_ms", "passing", "environment", "failed"),
    [
        pytest.param(2 * STOOD_STILL_MS, 0, ON_EMULATED, 1, id="emulated, and stood still"),
        pytest.param(
            2 * STOOD_STILL_MS, 1, ON_EMULATED, 0, id="emulated, and stood still for one that passed"
        ),
        pytest.param(0, 1, ON_EMULATED, LEFT_OUT_MAX + 1, id="emulated, and kept its time"),
        pytest.param(2 * STOOD_STILL_MS, 1, {}, LEFT_OUT_MAX + 1, id="a machine of one's own"),
    ],
)
def test_few_tests_for_which_an_emulated_machine_stood_still_are_left_out(
    tmp_path: Path, late_ms: int, passing: int, environment: dict[str, str], failed: int
) -> None:
    text = f"""
        import os, signal
        from pathlib import Path
        import pytest
        from tests.test_stillness import rest

        @pytest.mark.xdist_group("real time")
        @pytest.mark.parametrize("passes", [True] * {passing} + [False] * {LEFT_OUT_MAX + 1})
        def test_that_fails(passes):
            for witness in map(int, Path("/proc/thread-self/children").read_text().split()):
                if {late_ms}:
                    os.kill(witness, signal.SIGSTOP)
                    rest({late_ms})
                    os.kill(witness, signal.SIGCONT)
                    rest(20)
            assert passes
    """
    ran = pytest_in(tmp_path, text, environment)
    left_out = LEFT_OUT_MAX + 1 - failed
    assert ran.returncode == (1 if failed else 0), ran.stdout
    assert (f"{failed} failed" in ran.stdout) == bool(failed)
    assert (f"{left_out} skipped" in ran.stdout) == bool(left_out)
    assert ran.stdout.count("left out, as the emulated machine stood still") == left_out


def test_what_has_not_begun_in_the_time_allowed_is_skipped_and_a_failure_before_it_stands(
    tmp_path: Path,
) -> None:
    text = """
        import pytest
        from tests.test_stillness import rest

        @pytest.mark.parametrize("number", range(3))
        def test_that_takes_long(number):
            rest(1500)
            assert number
    """
    ran = pytest_in(tmp_path, text, {"SERVOBENCH_SECONDS": "1"})
    assert ran.returncode == 1, ran.stdout
    assert "1 failed, 2 skipped" in ran.stdout
    assert "no time left for 2 tests, the first test_late.py" in ran.stdout


def pytest_in(folder: Path, text: str, environment: dict[str, str]) -> "subprocess.CompletedProcess[str]":
    """What pytest, with this repository's conftest, says of a test file in ``folder``."""
    (folder / "test_late.py").write_text(dedent(text), encoding="utf-8")
    root = Path(__file__).parents[1]
    clean = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "SERVOBENCH_"))
    }
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.conftest", "--rootdir", str(folder), "test_late.py"],
        cwd=folder,
        env=clean | environment | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )
