"""``python -m tests.exits.elsewhere KIND``: the ways of :mod:`tests.exits.misuse` where no ``hil run`` in
simulated time is.

pytest    a controller in a run of ``servo_bench``. No test is green whose controller did not count each
          cycle, or did what ends a run; pytest leaves with 0 and without a summary by native code alone
hub       a controller in ``hil run`` on a hub, whose drive turns. A third client sees it at rest soon after;
          status and object as everywhere
campaign  a check beside a certificate that no run keeps: whatever it does, the campaign never leaves with 0
"""

import argparse
import gc
import os
import re
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pytest

import servobench
from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil import cli
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.testing.hosted import DriveProcess
from servobench.hil.verdict.verdict import ExitStatus
from servobench.virtual_bus.child_python import python_command
from tests.exits import misuse
from tests.exits.misuse import CYCLES, ENDING, HARMLESS, Case, bench_of, called_functions, drawn, status_of
from tests.exits.misused_hooks import __file__ as hooks_file
from tests.scenario.processes import observer
from tests.scenario.test_campaign_certificate import boasting, sweep

TORQUE_NM: Final = 0.2
"""On the hub: 50 rad/s when its code does what it does."""
BEGUN: Final = 20
"""Cycles before that."""
LIMIT_S: Final = 90.0
"""A process that holds every pipe for 20 s, and what shared cores take."""
REST_LIMIT_S: Final = 3.0
"""Its own supervision waits 0.5 s; a command that ends itself has its drives stopped by its parent."""
NATIVE: Final = frozenset(way for way in ENDING if re.search(r"CDLL\(None\)\._?exit\(0\)", way))
"""They end the process with status 0 past Python: docs have pytest run with workers for that."""
TEST: Final = """
def test_its_own(servo_bench):
    servo_bench({bench!r}).assert_passed()


def test_other():
    pass
"""


class Ended(NamedTuple):
    """A process."""

    status: int
    text: str
    said: str
    cycles: int


class Place:
    """Files and processes of one kind of command, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tally, self.out, self.said = folder / "tally", folder / "stdout", folder / "stderr"
        self._owner = os.getpid()

    def ended(self, case: Case, become: Callable[[Case], None]) -> Ended:
        """Run ``become`` in a copy of this process, with stdout and stderr in files."""
        for left in (self.tally, self.out, self.said):
            left.write_bytes(b"")
        if not (process := os.fork()):
            for place, path in ((1, self.out), (2, self.said)):
                os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), place)
            if case.hook == "import":
                os.environ["HOOKS_AT_IMPORT"] = case.way
            become(case)
        status = status_of(process, LIMIT_S)
        text, said = (path.read_text(errors="replace") for path in (self.out, self.said))
        return Ended(status, text, said, self.tally.stat().st_size)

    def findings(self, case: Case) -> Iterator[str]:
        """Run the case; yield what is not as it has to be."""
        raise NotImplementedError

    def warm(self) -> None:
        """Import what a case needs."""

    def close(self) -> None:
        """End what was started."""


class InPytest(Place):
    """A run in a test of a user's."""

    def warm(self) -> None:
        """Import what the fixtures do."""
        from servobench.hil.testing import bench_runs, hosted

        assert bench_runs
        assert hosted

    def findings(self, case: Case) -> Iterator[str]:
        bench, test = self.folder / "bench.toml", self.folder / "test_user.py"
        bench.write_text(bench_of(case, self.tally).config.resolved_text(), encoding="utf-8")
        test.write_text(TEST.format(bench=str(bench)), encoding="utf-8")
        words = [
            "-q",
            "-c",
            os.devnull,
            "--rootdir",
            str(self.folder),
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
        ]
        ended = self.ended(case, lambda _: sys.exit(pytest.main([*words, str(test)])))
        green = ended.status == 0 and re.search(r"^2 passed", ended.text, re.MULTILINE)
        if green and (case.way in ENDING or ended.cycles < CYCLES):
            yield f"green after {ended.cycles} cycles"
        elif not green and ended.status == 0 and case.way not in NATIVE:
            yield f"status 0 without a green summary: {ended.text[-300:]!r}"
        elif case.harmless and not green:
            yield f"status {ended.status}, and it was to be green: {ended.text[-900:]}{ended.said[-300:]}"
        if ended.status == -signal.SIGKILL and "SIGKILL" not in case.way:
            yield "it did not end"


class OnHub(Place):
    """A run on a hub, whose drive is another process."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._bus = f"hub:elsewhere-{os.getpid()}"
        command = python_command("servobench.hil.cli", "simulate", "--bus", self._bus, "--node", "1")
        self._drive = DriveProcess(command, folder / "drive.log")

    def findings(self, case: Case) -> Iterator[str]:
        path, controller = self.folder / "bench.toml", "drive.axis1.controller.parameters.torque_nm"
        bench = bench_of(case, self.tally).changed({controller: TORQUE_NM, "bus.spec": self._bus})
        path.write_text(bench.config.resolved_text(), encoding="utf-8")
        sys.argv = ["hil", "run", str(path), "--record", str(self.folder / f"run-{case.number}"), "--json"]
        ended = self.ended(case, lambda _: cli.main())
        with observer(self._bus) as drive:
            try:
                drive.time_to_rest(drive.now(), REST_LIMIT_S)
            except (AssertionError, BenchError) as error:
                yield f"left turning: {error}"
        as_run = misuse.Ended(ended.status, ended.text, ended.said, max(ended.cycles, CYCLES), 0.0)
        fair = case._replace(way="") if case.harmless else case  # a busy machine may miss too many cycles
        yield from misuse.findings(fair, as_run)
        if ended.status == ExitStatus.PASSED and ended.cycles < BEGUN:
            yield f"passed, and the controller counted {ended.cycles} cycles"

    def close(self) -> None:
        if os.getpid() == self._owner:
            self._drive.finish()


class InCampaign(Place):
    """A check of the user's beside a certificate that promises too much."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        own = {"check": f"{hooks_file}:check"}
        vary = [{"key": "faults.delay.0.delay_max_us", "values": [1000]}]
        self._sweep = folder / "sweep.toml"
        self._sweep.write_text(
            toml_text(sweep(1, boasting(folder, 5.0), vary=vary, own=own)), encoding="utf-8"
        )

    def warm(self) -> None:
        """Import and compile what a campaign does."""
        assert self._ended(Case(-1, "pass", "", "file", "file"), 1).status == ExitStatus.COUNTER_EXAMPLE

    def findings(self, case: Case) -> Iterator[str]:
        workers = 2 if case.number % 4 == 3 else 1
        ended = self._ended(case._replace(hook=""), workers)
        if ended.status not in set(ExitStatus) - {ExitStatus.PASSED, ExitStatus.DEFECT}:
            yield f"status {ended.status} with {workers} workers"
        elif case.harmless and ended.status != ExitStatus.COUNTER_EXAMPLE:
            yield f"status {ended.status} with {workers} workers, and it was to be a counter-example"

    def _ended(self, case: Case, workers: int) -> Ended:
        out = self.folder / f"campaign-{case.number}"
        command = ["campaign", str(self._sweep), "--out", str(out), "--workers", str(workers)]
        sys.argv = ["hil", *command, "--against", "certificate", "--json"]

        def become(case: Case) -> None:
            os.environ["HOOKS_IN_CHECK"] = case.way
            cli.main()

        return self.ended(case, become)


PLACES: Final = {"pytest": InPytest, "hub": OnHub, "campaign": InCampaign}


def main() -> int:
    """Print what was wrong, and how many there were."""
    parser = argparse.ArgumentParser(prog="python -m tests.exits.elsewhere", description=__doc__)
    parser.add_argument("kind", choices=PLACES)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e6)
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp())  # no context: a command that is forked in here leaves through it
    servobench.run(bench_of(Case(0, "pass", "output", "file", "file"), folder / "tally"))
    called = called_functions(folder)
    place = PLACES[asked.kind](folder)
    try:
        place.warm()
        return _draw(place, called, asked.runs, asked.seed, asked.seconds)
    finally:
        place.close()


def _draw(place: Place, called: Sequence[str], runs: int, seed: int, seconds: float) -> int:
    gc.freeze()
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    clock = MonotonicClock()
    ends_at = clock.now() + seconds * NS_PER_S
    counts: Counter[str] = Counter()
    for number in range(runs):
        if clock.now() > ends_at:
            break
        case = drawn(number, seed, called)
        found = list(place.findings(case))
        counts["runs"] += 1
        counts["harmless"] += case.way in HARMLESS
        counts["ending"] += case.way in ENDING
        counts["wrong"] += bool(found)
        for text in found:
            print(f"{case}: {text}", flush=True)
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    return int(counts["wrong"] > 0)


if __name__ == "__main__":
    sys.exit(main())
