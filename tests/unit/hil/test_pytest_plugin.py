"""The fixtures of the pytest plugin in a project of a few tests: buses, drives, folders of recordings."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.wire import adapters
from servobench.hil import pytest_plugin
from servobench.hil.testing import bench_runs, campaign_runs, drive_rig, hosted

pytest_plugins = ["pytester"]


_BARE = [
    word
    for name in ("cacheprovider", "xdist", "timeout", "rerunfailures", "hypothesispytest", "pytester")
    for word in ("-p", f"no:{name}")
]
"""Of the other plugins none is needed, and each costs time."""


class Project:
    """Tests that note what they were given in a file."""

    def __init__(self, pytester: pytest.Pytester) -> None:
        self._pytester = pytester
        self.folder = pytester.path

    def run(self, text: str, *options: str) -> tuple[dict[str, int], list[str], str]:
        """Outcomes, what was noted, and what was said."""
        head = "from pathlib import Path\nimport pytest\n"
        head += "def note(*what):\n    with open('noted', 'a') as file:\n        print(*what, file=file)\n"
        noted = self.folder / "noted"
        noted.unlink(missing_ok=True)
        self._pytester.makepyfile(test_it=head + text)
        done = self._pytester.runpytest_inprocess("-rs", *_BARE, *options)
        outcomes = done.parseoutcomes()
        outcomes.pop("warnings", None)
        lines = noted.read_text().splitlines() if noted.exists() else []
        return outcomes, lines, done.stdout.str()

    def told(self, option: str) -> str:
        """What an option that runs no test says."""
        return self._pytester.runpytest_inprocess(option, *_BARE).stdout.str()


@pytest.fixture
def project(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Project:
    """On a machine without SocketCAN."""
    monkeypatch.setattr(adapters, "socketcan_links", list)
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    return Project(pytester)


ANY_BUS = "def test_any(servo_bus):\n    note(servo_bus)\n"
TWO_BUSES = '@pytest.mark.servo_bus("simulated", "hub")\ndef test_two(servo_bus):\n    note(servo_bus)\n'


def hub_number(spec: str) -> int:
    found = re.fullmatch(rf"hub:test-{os.getpid()}-(\d+)", spec)
    assert found is not None, spec
    return int(found[1])


def test_a_test_is_simulated_unless_it_says_otherwise(project: Project) -> None:
    outcomes, noted, _ = project.run(ANY_BUS + TWO_BUSES + TWO_BUSES.replace("two", "again"))
    assert outcomes == {"passed": 5}
    assert [noted[place] for place in (0, 1, 3)] == ["simulated"] * 3
    assert hub_number(noted[4]) == hub_number(noted[2]) + 1, "no two tests share a hub"


def test_the_command_line_names_the_bus_of_tests_that_name_none(project: Project) -> None:
    outcomes, noted, _ = project.run(ANY_BUS + TWO_BUSES, "--servo-bus", "hub")
    assert outcomes == {"passed": 3}
    assert noted[1] == "simulated"
    assert hub_number(noted[2]) == hub_number(noted[0]) + 1
    assert project.run(ANY_BUS, "--servo-bus", "hub:mine")[1] == ["hub:mine"]


def test_an_interface_that_is_not_up_skips_a_test_or_fails_it_if_it_was_asked_for(project: Project) -> None:
    marked = '@pytest.mark.servo_bus("vcan")\n' + ANY_BUS
    outcomes, noted, said = project.run(marked)
    assert (outcomes, noted) == ({"skipped": 1}, [])
    assert "vcan0 is not up" in said
    assert "ip link" in said
    outcomes, noted, said = project.run(ANY_BUS, "--servo-bus", "socketcan:can7")
    assert (outcomes, noted) == ({"errors": 1}, [])
    assert "can7 is not up" in said
    assert "Traceback" not in said


def test_an_interface_that_is_up_is_the_bus(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    links = [SimpleNamespace(spec="socketcan:vcan0", usable=True)]
    links += [SimpleNamespace(spec="socketcan:can1", usable=False)]
    monkeypatch.setattr(adapters, "socketcan_links", lambda: links)
    assert project.run(ANY_BUS, "--servo-bus", "vcan")[1] == ["socketcan:vcan0"]
    assert project.run(ANY_BUS, "--servo-bus", "socketcan:can1")[0] == {"errors": 1}


@pytest.mark.parametrize("options", [(), ("--servo-bus", "simulated")])
def test_drives_that_are_present_are_on_a_bus_that_is_named(
    project: Project, options: tuple[str, ...]
) -> None:
    outcomes, noted, said = project.run(ANY_BUS, "--servo-drives", "present", *options)
    assert (outcomes, noted) == ({"errors": 1}, [])
    assert "--servo-drives present needs --servo-bus with the drives' bus" in said


def test_a_bus_of_its_own_has_no_drive_that_is_present(project: Project) -> None:
    outcomes, noted, said = project.run(
        ANY_BUS + TWO_BUSES, "--servo-drives", "present", "--servo-bus", "hub:x"
    )
    assert (outcomes, noted) == ({"passed": 1, "skipped": 2}, ["hub:x"])
    assert "it has a bus of its own, on which no drive is present" in said


class Host:
    """Starts nothing."""

    made: list["Host"]

    def __init__(self, spec: str, scratch: Path, present: bool) -> None:
        self.spec, self.present = spec, present
        self.started: list[Any] = []
        self.ended = 0
        assert scratch.is_dir()
        self.made.append(self)

    def start(self, nodes: Any, wish: Any) -> str:
        self.started.append((tuple(nodes), wish))
        return "its process"

    def end(self) -> None:
        self.ended += 1


@pytest.fixture
def hosts(monkeypatch: pytest.MonkeyPatch) -> list[Host]:
    Host.made = []
    monkeypatch.setattr(hosted, "DriveHost", Host)
    return Host.made


PROCESSES = """
def test_processes(servo_process):
    note(servo_process(4, 5, seed=7))
    note(servo_process(node=3))
"""


def test_processes_are_started_as_a_test_wishes(project: Project, hosts: list[Host]) -> None:
    outcomes, noted, _ = project.run(PROCESSES, "--servo-bus", "hub:x")
    assert (outcomes, noted) == ({"passed": 1}, ["its process"] * 2)
    (host,) = hosts
    assert (host.spec, host.present, host.ended) == ("hub:x", False, 1)
    (first, wish), (second, other) = host.started
    assert (first, wish.seed, wish.node) == ((4, 5), 7, 1)
    assert (second, other.node) == ((3,), 3)


def test_processes_need_a_bus_in_real_time_and_drives_of_their_own(
    project: Project, hosts: list[Host]
) -> None:
    outcomes, _, said = project.run(PROCESSES)
    assert outcomes == {"errors": 1}
    told = "servo_process needs a bus in real time: mark the test with servo_bus('hub') or run pytest with "
    assert f"{told}--servo-bus" in said
    outcomes, _, said = project.run(PROCESSES, "--servo-bus", "hub:x", "--servo-drives", "present")
    assert outcomes == {"skipped": 1}
    assert "it makes drives of its own, and --servo-drives is present" in said
    assert [host.ended for host in hosts] == [1, 1]
    assert [host.started for host in hosts] == [[], []]


def test_drives_are_made_with_their_masters_and_released(
    project: Project, hosts: list[Host], monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs: list[Any] = []

    class Rig:
        def __init__(self, bus: str, host: Host, wish: Any) -> None:
            self.given, self.left = (bus, host, wish.node), False
            rigs.append(self)

        def __enter__(self) -> str:
            return f"rig {self.given[2]}"

        def __exit__(self, *_: object) -> None:
            self.left = True

    monkeypatch.setattr(drive_rig, "drive_rig", Rig)
    test = "def test_rigs(servo_drive):\n    note(servo_drive(node=2))\n    note(servo_drive(eds=None))\n"
    assert project.run(test)[:2] == ({"passed": 1}, ["rig 2", "rig 1"])
    assert [rig.given for rig in rigs] == [("simulated", hosts[0], 2), ("simulated", hosts[0], 1)]
    assert all(rig.left for rig in rigs)
    present = ("--servo-bus", "hub:x", "--servo-drives", "present")
    wishing = "".join(
        f"def test_{name}(servo_drive):\n    servo_drive({name}='x')\n"
        for name in pytest_plugin.ONLY_SIMULATED
    )
    outcomes, noted, said = project.run(test + wishing, *present)
    assert (outcomes, noted) == ({"passed": 1, "skipped": 3}, ["rig 2", "rig 1"])
    for name in ("faults", "eds", "store"):
        assert f"it asks for a drive with {name}, and --servo-drives is present" in said
    assert project.run(wishing)[0] == {"passed": 3}


BENCH = """
def test_runs(servo_bench):
    note(servo_bench)
    Path(servo_bench, "run-1").mkdir()
    Path(servo_bench, "run-2").mkdir()
    Path(servo_bench, "other").mkdir()

class TestIt:
    @pytest.mark.parametrize("x", ["a/b c"])
    def test_odd(self, servo_bench, x):
        note(servo_bench)
"""


@pytest.fixture
def runners(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """What runners of benches are made with; each stands for its folder."""
    given: list[Any] = []

    def runner(bus: str, host: Host, recordings: Path, folder: Path) -> Path:
        given.append((bus, host.spec, folder))
        return recordings

    monkeypatch.setattr(bench_runs, "BenchRunner", runner)
    return given  # type: ignore[return-value]


def test_runs_are_recorded_for_the_time_of_the_test(
    project: Project, hosts: list[Host], runners: list[Any]
) -> None:
    outcomes, noted, _ = project.run(BENCH, "--junitxml", "report.xml")
    assert outcomes == {"passed": 2}
    assert runners == [("simulated", "simulated", project.folder)] * 2
    assert [Path(line).name for line in noted] == ["bench0", "bench1"]
    report = (project.folder / "report.xml").read_text()
    told = re.findall(r'<property name="recording" value="([^"]*)"', report)
    assert told == [f"{noted[0]}/run-1", f"{noted[0]}/run-2"]
    assert len(hosts) == 2


def test_recordings_are_kept_where_the_command_line_says(
    project: Project, hosts: list[Host], runners: list[Any]
) -> None:
    names = ["test_it.py_test_runs", "test_it.py_TestIt_test_odd_a_b_c"]
    for again in ("", "-2", "-3"):
        noted = project.run(BENCH, "--servo-record", "kept/all")[1]
        folders = [project.folder / "kept" / "all" / f"{name}{again}" for name in names]
        assert noted == [str(folder) for folder in folders]
        assert all(folder.is_dir() for folder in folders)
    assert len(runners) == len(hosts) == 6


def test_campaigns_have_a_folder_of_their_own(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(campaign_runs, "CampaignRunner", lambda *what: given.append(what) or "runner")  # type: ignore[func-returns-value]
    outcomes, noted, _ = project.run("def test_campaign(servo_campaign):\n    note(servo_campaign)\n")
    assert (outcomes, noted) == ({"passed": 1}, ["runner"])
    ((scratch, folder),) = given
    assert (scratch.name, folder) == ("campaign0", project.folder)


def test_the_options_and_the_marker_are_told(project: Project) -> None:
    said = project.told("--help")
    for option in ("--servo-bus=SPEC", "--servo-drives={simulated,present}", "--servo-record=DIR"):
        assert option in said
    assert "@pytest.mark.servo_bus(*specs): run the test on each of these buses" in project.told("--markers")
