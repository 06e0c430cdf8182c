"""Commands of a few lines: what they are asked, what they say, and with which status they end."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.drivers.canopen.write_list import WriteList
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.cli import app
from servobench.hil.execution import recovered_run, world
from servobench.hil.inspecting import live_trace, stopping
from servobench.hil.inspecting.stopping import NodeStopped
from servobench.hil.machine import realtime
from servobench.hil.machine.extras import examples_folder
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.hil.terminal import init as init_command
from servobench.hil.terminal import report
from servobench.hil.write_lists import STOP
from servobench.virtual_bus.instruments import slcan_server
from servobench.virtual_bus.instruments.serial_line import LineFaults
from tests.told import ROOT

BENCH = ROOT / "examples" / "ling2012.toml"


def hil(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


# ---- stop ---------------------------------------------------------------------------------------------

AT_REST = NodeStopped(1, True, "operation enabled", "switch on disabled", 12.4, "at rest and disabled")
MOVES = NodeStopped(2, False, "", "", 5000.0, "no answer")


@pytest.fixture
def stops(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    kept: dict[str, Any] = {"stopped": [AT_REST]}

    @contextmanager
    def network(bus: str, bitrate: int, writes: WriteList) -> Iterator[str]:
        assert writes is STOP
        kept["opened"] = bus, bitrate
        yield "the network"
        kept["closed"] = True

    def stop(network: str, nodes: list[int]) -> list[NodeStopped]:
        assert "closed" not in kept
        kept["asked"] = network, nodes
        stopped: list[NodeStopped] = kept["stopped"]
        return stopped

    monkeypatch.setattr(world, "drive_network", network)
    monkeypatch.setattr(stopping, "stop_drives", stop)
    return kept


def test_drives_are_stopped_on_the_bus_that_is_named(stops: dict[str, Any]) -> None:
    told = hil("stop", "--bus", "hub:x")
    assert (told.exit_code, told.stdout) == (0, "node 1: at rest and disabled (after 12 ms)\n")
    assert stops["opened"] == ("hub:x", 1_000_000)
    assert stops["asked"] == ("the network", [])
    assert stops.pop("closed")
    hil("stop", "--bus", "hub:y", "--node", "1,3-4", "--node", "9", "--bitrate", "500000")
    assert stops["opened"] == ("hub:y", 500_000)
    assert stops["asked"] == ("the network", [1, 3, 4, 9])


def test_a_drive_that_is_not_at_rest_is_a_fault(stops: dict[str, Any]) -> None:
    stops["stopped"] = [AT_REST, MOVES]
    told = hil("stop", "--bus", "hub:x")
    assert told.exit_code == 3
    assert told.stdout.splitlines()[1:] == ["node 2: no answer (after 5000 ms)"]
    del stops["closed"]
    assert json.loads(hil("stop", "--bus", "hub:x", "--json").stdout) == {
        "at_rest": False,
        "nodes": [AT_REST._asdict(), MOVES._asdict()],
    }
    del stops["closed"]
    stops["stopped"] = []
    told = hil("stop", "--bus", "hub:x", "--json")
    assert (told.exit_code, json.loads(told.stdout)) == (0, {"at_rest": True, "nodes": []})


# ---- adapter ------------------------------------------------------------------------------------------


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What an adapter was to be; the process stays an ordinary one."""
    asked: list[Any] = []

    @contextmanager
    def process() -> Iterator[tuple[str, ...]]:
        yield ("locked memory", "a priority")

    def serve(spec: Any, *, clock: Any, stop: Any, announce: Any, **how: Any) -> None:
        asked.append((spec, how, stop()))
        announce("/dev/pts/7", "an adapter on it")
        assert clock.now() <= clock.now()

    monkeypatch.setattr(realtime, "realtime_process", process)
    monkeypatch.setattr(slcan_server, "serve_adapter", serve)
    return asked


def test_an_adapter_tells_its_port_on_stdout_and_all_else_beside(served: list[Any]) -> None:
    told = hil("adapter", "--bus", "hub:x")
    assert (told.exit_code, told.stdout) == (0, "/dev/pts/7\n")
    assert told.stderr.splitlines() == [
        "not granted by the kernel: locked memory",
        "not granted by the kernel: a priority",
        "an adapter on it",
    ]
    plain = {"bitrate_bit_s": None, "link": None, "faults": LineFaults(), "seed": 0}
    assert served == [(parse_bus_spec("hub:x"), plain, False)]


def test_an_adapter_has_the_faults_that_are_named(served: list[Any]) -> None:
    hil(
        "adapter", "--bus", "hub:x", "--link", "port", "--bitrate", "250000", "--seed", "4",
        "--fault", "garble=0.01", "--fault", "baud=115200",
    )  # fmt: skip
    assert served[0][1] == {
        "bitrate_bit_s": 250_000,
        "link": Path("port"),
        "faults": LineFaults(garble=0.01, baud=115200),
        "seed": 4,
    }
    told = hil("adapter", "--bus", "simulated")
    expected = "expected a bus that other processes can join; use hub:NAME"
    assert (told.exit_code, told.stderr) == (2, f"hil: error: --bus: found 'simulated', {expected}\n")
    assert len(served) == 1


# ---- recover ------------------------------------------------------------------------------------------


def test_a_run_is_recovered_by_its_own_bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    summary = SimpleNamespace(as_json=lambda: {"cycles": 7})

    def recover(config: Any, folder: Path) -> Any:
        asked.append((config.bench.name, folder))
        return summary

    monkeypatch.setattr(recovered_run, "recover_run", recover)
    monkeypatch.setattr(report, "print_run", lambda config, done: print(config.bench.name, done.as_json()))
    text = BENCH.read_text().replace('"motors/', f'"{BENCH.parent}/motors/')
    (tmp_path / "bench.toml").write_text(text.replace('"faults/', f'"{BENCH.parent}/faults/'))
    (tmp_path / "events.jsonl").touch()
    told = hil("recover", tmp_path)
    assert (told.exit_code, told.stdout) == (0, "ling2012 {'cycles': 7}\n")
    assert json.loads(hil("recover", tmp_path, "--json").stdout) == {"cycles": 7}
    assert asked == [("ling2012", tmp_path)] * 2


def test_what_is_no_run_is_not_recovered(tmp_path: Path) -> None:
    told = hil("recover", tmp_path)
    told_of = "hil: error: {}: found 'no {}', expected the folder of a recording; hil runs DIR lists them\n"
    assert (told.exit_code, told.stderr) == (2, told_of.format(tmp_path, "bench.toml"))
    (tmp_path / "bench.toml").write_text(BENCH.read_text())  # of a bench that was never run
    told = hil("recover", tmp_path)
    assert (told.exit_code, told.stderr) == (2, told_of.format(tmp_path, "records.arrow"))
    assert [path.name for path in tmp_path.iterdir()] == ["bench.toml"]
    absent = tmp_path / "absent"
    expected = "missing, expected the folder of a recording; hil runs DIR lists them"
    assert hil("recover", absent).stderr == f"hil: error: {absent}: {expected}\n"


# ---- init ---------------------------------------------------------------------------------------------

FIRST = {"bench.toml", "motor.toml", "controller.py", "test_controller.py", "sweep.toml"}
NEXT = [
    "  hil run bench.toml        close the loop in simulated time, record and judge it",
    "  pytest                    test the controller with lost readings and a silent drive",
    "  hil campaign sweep.toml   run the bench with losses and a tolerance of the inertia",
]


def test_a_first_bench_is_the_example_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "new" / "bench"
    told = hil("init", folder)
    assert (told.exit_code, told.stderr) == (0, f"written {folder}\n")
    assert told.stdout.splitlines() == [f"Next, in {folder}:", *NEXT]
    source = examples_folder() / "first"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        name: (source / name).read_bytes() for name in FIRST
    }
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert hil("init").stdout.splitlines() == ["Next:", *NEXT]
    assert {path.name for path in (tmp_path / "here").iterdir()} == FIRST


def test_no_file_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "motor.toml").write_text("mine")
    told = hil("init", tmp_path)
    expected = "expected a folder without this file; no file is overwritten"
    there = tmp_path / "motor.toml"
    assert (told.exit_code, told.stderr) == (2, f"hil: error: DIR: found '{there}', {expected}\n")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_examples_are_written_with_their_folders_and_without_what_runs_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "source"
    for name in ("a.toml", "deep/down/b.toml", "deep/__pycache__/c.pyc", "runs/d.toml"):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(name)
    monkeypatch.setattr(init_command, "examples_folder", lambda: source)
    told = hil("init", tmp_path / "there", "--examples")
    target = tmp_path / "there" / "examples"
    assert (told.exit_code, told.stdout, told.stderr) == (0, "", f"written {target}\n")
    assert {str(path.relative_to(target)) for path in target.rglob("*.*")} == {"a.toml", "deep/down/b.toml"}


# ---- values that an option does not take ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--seed", "-1"), "'--seed': found '-1', expected a value >= 0"),
        (("--seed", "one"), "'--seed': found 'one', expected a whole number"),
        (("--time", "fast"), "'--time': found 'fast', expected one of 'simulated', 'real'"),
    ],
)
def test_a_value_is_told_as_in_a_file(words: tuple[str, ...], told: str) -> None:
    said = CliRunner().invoke(app, ["run", str(BENCH), *words], env={"COLUMNS": "120"})
    assert said.exit_code == 2
    assert told in said.stderr


# ---- docs ---------------------------------------------------------------------------------------------


def test_the_documentation_is_listed_and_a_page_printed_without_what_only_tests_read() -> None:
    listed = hil("docs")
    assert "exit-status                   Exit status\n" in listed.stdout
    assert f"All of them lie in {ROOT / 'docs'}\n" in listed.stdout
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    assert "<!-- runs -->\n" in page
    for name in ("install", "install.md", "docs/install.md"):
        assert hil("docs", name).stdout == page.replace("<!-- runs -->\n", "")


@pytest.mark.parametrize(
    ("page", "remedy"),
    [
        ("instal", "; is install meant?"),
        ("instoll", "; is install meant?"),
        ("tutorial", "; is tutorial-commissioning or tutorial-pytest or tutorial-review meant?"),
        ("xyz", ""),
    ],
)
def test_a_page_that_is_none_is_refused(page: str, remedy: str) -> None:
    told = hil("docs", page)
    expected = f"hil: error: PAGE: found '{page}', expected a page that hil docs lists{remedy}\n"
    assert (told.exit_code, told.stderr) == (2, expected)


def test_a_log_that_is_not_there_is_called_missing() -> None:
    told = hil("trace", "no-such.log")
    assert (told.exit_code, told.stderr.partition(", ")[0]) == (2, "hil: error: no-such.log: missing")


# ---- trace --live -------------------------------------------------------------------------------------


def test_a_live_bus_is_followed_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def frames(spec: Any, bitrate: int | None, stop: Any, tell: Any) -> Iterator[LogFrame]:
        asked.append((spec, bitrate, stop()))
        tell("500000 bit/s")
        yield LogFrame(1, 1_500_000_000, "x", 0x080, b"")
        yield LogFrame(2, 2_000_000_000, "x", 0x701, b"\x05")

    monkeypatch.setattr(live_trace, "live_frames", frames)
    told = hil("trace", "--live", "--bus", "hub:x", "--bitrate", "250000")
    assert [line.split() for line in told.stdout.splitlines()] == [
        ["1.500000", "x", "080", "sync", "SYNC"],
        ["2.000000", "x", "701", "heartbeat", "node", "1", "operational"],
    ]
    assert (told.stderr, asked) == ("500000 bit/s\n", [(parse_bus_spec("hub:x"), 250_000, False)])
    lines = hil("trace", "--live", "--bus", "hub:x", "--node", "1", "--json").stdout.splitlines()
    assert [json.loads(line)["at_s"] for line in lines] == [2.0]
    assert asked[1][1] is None
