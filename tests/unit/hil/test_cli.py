"""The command line: options in, exit statuses and streams out. The bench behind it is a stand-in."""

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.drivers.errors import BadInput, BusDown, DriveInFault, NoAnswer
from servobench.hil.cli import app
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.machine.doctor import Capability
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.rows.seal import SEALED
from servobench.hil.terminal.options import node_ids, serial_numbers
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import ExitStatus, Finding, VerdictKind
from tests.unit.hil.test_report import summary

EXAMPLES = Path(__file__).parents[3] / "examples"
HOOKS = ("progress", "recording", "concluded")
BENCH = str(EXAMPLES / "ling2012.toml")


class Bench:
    """Stands in for what runs a bench or a drive: keeps what it was asked, answers what the test wants."""

    def __init__(self) -> None:
        self.asked: dict[str, Any] = {}
        self.config: BenchConfig | None = None
        self.error: BaseException | None = None
        self.summary = summary()
        self.begins = False
        """Whether there is a run before the error."""

    def run_bench(self, config: BenchConfig, **asked: Any) -> Summary:
        self.config, self.asked = config, asked
        if self.begins:
            asked["concluded"](self.summary)
        if self.error:
            raise self.error
        asked["progress"]("running", 1.0)
        return self.summary

    def simulate(self, **asked: Any) -> None:
        self.asked = asked
        if self.error:
            raise self.error
        asked["announce"]("node 1 is on hub:a")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    found = Bench()
    stand_ins = {
        "servobench.hil.execution.bench": ("run_bench", found.run_bench),
        "servobench.hil.execution.simulated_drives": ("simulate", found.simulate),
    }
    for name, (function, stand_in) in stand_ins.items():
        module = ModuleType(name)
        setattr(module, function, stand_in)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr("servobench.hil.rows.seal.check_seal", lambda _folder: SEALED)
    return found


def hil(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


@pytest.mark.usefixtures("bench")
def test_a_passed_run_prints_its_summary() -> None:
    result = hil("run", BENCH)
    assert result.exit_code == ExitStatus.PASSED
    assert "ling2012: PASSED" in result.stdout
    assert "runs/x/run.rrd" in result.stdout


def test_a_failed_run_leaves_with_one(bench: Bench) -> None:
    bench.summary = summary(passed=False)
    result = hil("run", BENCH)
    assert result.exit_code == ExitStatus.FAILED
    assert "NOT PASSED" in result.stdout


def test_an_interrupted_run_prints_what_it_has_and_leaves_with_130(bench: Bench) -> None:
    bench.summary = summary().also(Finding(VerdictKind.INTERRUPTED, "ended by SIGINT"))
    result = hil("run", BENCH)
    assert result.exit_code == ExitStatus.INTERRUPTED
    assert "INTERRUPTED" in result.stdout
    assert "PASSED" not in result.stdout


def test_options_reach_the_bench(bench: Bench) -> None:
    hil(
        "run",
        BENCH,
        "--bus",
        "hub:a",
        "--time",
        "real",
        "--seed",
        "7",
        "--record",
        "r",
        "--view",
        "--network",
        "n.toml",
        "--allow-uncertified",
    )
    assert bench.config is not None
    assert bench.config.bench.name == "ling2012"
    asked = {
        key: value for key, value in bench.asked.items() if key not in ("progress", "recording", "concluded")
    }
    expected = {"bus_spec": "hub:a", "time": "real", "seed": 7, "record": Path("r"), "view": True}
    expected |= {"network": Path("n.toml"), "allow_uncertified": True, "keep": True, "served": None}
    assert asked == expected


def test_without_options_the_file_decides(bench: Bench) -> None:
    hil("run", BENCH)
    asked = {
        key: value for key, value in bench.asked.items() if key not in ("progress", "recording", "concluded")
    }
    expected = {"bus_spec": None, "time": None, "seed": None, "record": None, "view": False, "served": None}
    assert asked == expected | {"network": None, "allow_uncertified": False, "keep": True}


@pytest.mark.parametrize("options", [["--record", "r"], ["--view"], ["--serve"]])
def test_no_recording_beside_one_that_is_asked_for_is_bad_input(bench: Bench, options: list[str]) -> None:
    assert hil("run", BENCH, "--no-record", *options).exit_code == ExitStatus.BAD_INPUT
    assert not bench.asked
    hil("run", BENCH, "--no-record")
    assert bench.asked["keep"] is False


def test_json_is_one_object_on_stdout_and_nothing_else(bench: Bench) -> None:
    bench.summary = summary(passed=False)
    result = hil("run", BENCH, "--json")
    assert result.exit_code == ExitStatus.FAILED
    assert json.loads(result.stdout) == json.loads(json.dumps(summary(passed=False).as_json()))
    assert result.stderr == "running\n"


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (BusDown("socketcan:can0 is down", remedy="ip link set can0 up"), ExitStatus.PEER_FAULT),
        (NoAnswer("node 1 does not answer on hub:a"), ExitStatus.PEER_FAULT),
        (DriveInFault("node 1 is in fault", "0x603F = 0x2310"), ExitStatus.PEER_FAULT),
        (KeyboardInterrupt(), ExitStatus.INTERRUPTED),
        (ZeroDivisionError("a defect"), ExitStatus.DEFECT),
    ],
)
def test_an_error_leaves_with_its_status_and_an_empty_stdout(
    bench: Bench, error: BaseException, status: ExitStatus
) -> None:
    bench.error = error
    result = hil("run", BENCH)
    assert result.exit_code == status
    assert result.stdout == ""
    assert str(error) in result.stderr
    assert ("Traceback" in result.stderr) == (status is ExitStatus.DEFECT)


ERRORS = [
    (BadInput("bench.toml", "loop", 1, "2"), ExitStatus.BAD_INPUT),
    (BusDown("can0 is down"), ExitStatus.PEER_FAULT),
    (Interrupted("ended by SIGTERM"), ExitStatus.INTERRUPTED),
    (KeyboardInterrupt(), ExitStatus.INTERRUPTED),
    (ZeroDivisionError("a defect"), ExitStatus.DEFECT),
]


@pytest.mark.parametrize(("error", "status"), ERRORS)
@pytest.mark.parametrize("begins", [False, True])
def test_json_is_one_object_at_every_exit(
    bench: Bench, error: BaseException, status: ExitStatus, begins: bool
) -> None:
    bench.error, bench.begins = error, begins
    result = hil("run", BENCH, "--json")
    told = from_plain(Summary, json.loads(result.stdout))
    assert result.exit_code == told.verdict.exit_status == status
    assert str(error) in told.verdict.reason or isinstance(error, KeyboardInterrupt)
    assert not told.verdict.passed
    assert (told.cycles, told.recording) == ((2000, "runs/x") if begins else (0, ""))


@pytest.mark.parametrize("as_json", [False, True])
def test_of_an_error_and_what_the_run_came_to_the_gravest_is_the_status(bench: Bench, as_json: bool) -> None:
    found = (Finding(VerdictKind.PEER_FAULT, "lost"), Finding(VerdictKind.NOT_RECORDED, "the disk is full"))
    bench.summary = bench.summary.also(found[0]).also(found[1])
    bench.error, bench.begins = RecordingFailed("the disk is full"), True
    result = hil("run", BENCH, *(["--json"] if as_json else []))
    assert result.exit_code == ExitStatus.PEER_FAULT
    if as_json:
        assert from_plain(Summary, json.loads(result.stdout)) == bench.summary, "as in summary.json"


@pytest.mark.usefixtures("bench")
@pytest.mark.parametrize(
    "arguments",
    [["missing.toml"], [BENCH, "--time", "sideways"], [BENCH, "--seed", "-1"], [BENCH, "--nonsense"], []],
)
def test_json_is_one_object_for_what_cannot_be_used(arguments: list[str]) -> None:
    result = hil("run", *arguments, "--json")
    told = json.loads(result.stdout)
    assert result.exit_code == told["verdict"]["exit_status"] == ExitStatus.BAD_INPUT
    assert told["verdict"]["reason"]
    assert (told["cycles"], told["bus_load_percent"], told["seed"]) == (0, None, None)


@pytest.mark.usefixtures("bench")
def test_bad_input_lists_all_errors_without_a_traceback(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text('[bench]\nname = "x"\nduration_ms = 2000\n[bus]\nbitrate_bit_s = 5\n')
    result = hil("run", str(path))
    assert result.exit_code == ExitStatus.BAD_INPUT
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert lines[0] == "hil: 3 errors:"
    assert lines[1] == (
        f"  {path}: bench.duration_ms: found 2000, expected duration_s (the unit is part of the key); "
        "write duration_s = 2"
    )
    assert len(lines) == 4


@pytest.mark.usefixtures("bench")
@pytest.mark.parametrize(
    "arguments",
    [
        ["run"],
        ["run", "missing.toml"],
        ["run", BENCH, "--time", "sideways"],
        ["run", BENCH, "--seed", "-1"],
        ["run", BENCH, "--nonsense"],
        ["nonsense"],
        ["simulate", "--bus", "hub:a"],
        ["simulate", "--bus", "hub:a", "--node", "128"],
        ["simulate", "--bus", "hub:a", "--node", "9" * 5000],
        ["simulate", "--bus", "hub:a", "--node", "1", "--motor", "missing.toml"],
        ["simulate", "--bus", "hub:a", "--node", "1", "--faults", "missing.toml"],
    ],
)
def test_bad_arguments_leave_with_two(arguments: list[str]) -> None:
    result = hil(*arguments)
    assert result.exit_code == ExitStatus.BAD_INPUT
    assert result.stdout == ""
    assert result.stderr
    assert "Traceback" not in result.stderr


def test_simulate_hands_over_nodes_motor_and_faults(bench: Bench) -> None:
    motor, faults = str(EXAMPLES / "motors" / "azaiz2007.toml"), str(EXAMPLES / "faults" / "demo.toml")
    result = hil(
        "simulate",
        "--bus",
        "hub:a",
        "--node",
        "1",
        "3-4",
        "--node",
        "7",
        "--motor",
        motor,
        "--faults",
        faults,
    )
    assert result.exit_code == 0, result.stderr
    assert sorted(bench.asked["nodes"]) == [1, 3, 4, 7]
    assert bench.asked["motor"].name == "Azaiz2007"
    assert bench.asked["faults"].faults
    assert (bench.asked["bus_spec"], bench.asked["bitrate_bit_s"], bench.asked["seed"]) == (
        "hub:a",
        1_000_000,
        0,
    )
    assert bench.asked["files"] == (None, None, None)
    assert "node 1 is on hub:a" in result.stderr


def test_simulate_hands_over_the_devices_files(bench: Bench) -> None:
    files = ("--eds", "some.eds", "--store", "memory.json", "--export-eds", "own.eds")
    result = hil("simulate", "--bus", "hub:a", "--node", "unconfigured", *files)
    assert result.exit_code == 0, result.stderr
    assert bench.asked["nodes"] == [255]
    assert bench.asked["files"] == (Path("some.eds"), Path("memory.json"), Path("own.eds"))


def test_simulate_has_a_default_motor_and_no_faults(bench: Bench) -> None:
    hil("simulate", "--bus", "hub:a", "--node", "1")
    assert bench.asked["motor"] == LING2012.parameters
    assert bench.asked["faults"] is None


@pytest.fixture
def checks(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Capability(
            "vcan0",
            "lack",
            "no such link",
            "--bus socketcan:vcan0",
            "ip link add dev vcan0 type vcan",
        ),
        Capability("disk space", "ok", "50 GB free", "recordings"),
    ]
    monkeypatch.setattr("servobench.hil.machine.doctor.run_checks", lambda: found)


@pytest.mark.usefixtures("checks")
def test_doctor_prints_each_lack_with_its_remedy() -> None:
    result = hil("doctor")
    assert result.exit_code == 0
    assert "ip link add dev vcan0 type vcan" in result.stdout
    assert "disk space" in result.stdout


@pytest.mark.usefixtures("checks")
def test_doctor_as_json() -> None:
    found = json.loads(hil("doctor", "--json").stdout)
    assert [(check["name"], check["status"]) for check in found] == [("vcan0", "lack"), ("disk space", "ok")]


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["1"], [1]),
        (["1,2", "5"], [1, 2, 5]),
        (["3-5"], [3, 4, 5]),
        (["127"], [127]),
        (["unconfigured:3"], [255] * 3),
        (["1,unconfigured", "unconfigured"], [1, 255, 255]),
    ],
)
def test_node_ids(texts: list[str], expected: list[int]) -> None:
    assert node_ids(texts) == expected


@pytest.mark.parametrize(
    "text", ["unconfigured:0", "unconfigured:128", "unconfigured:", "unconfigured:x", "1,1"]
)
def test_node_ids_that_are_none(text: str) -> None:
    with pytest.raises(BadInput):
        node_ids([text])


@pytest.mark.parametrize(
    ("texts", "expected"),
    [([], []), (["7"], [7, 8, 9]), (["0x10"], [16, 17, 18]), (["9,2", "0xFFFFFFFF"], [9, 2, 0xFFFF_FFFF])],
)
def test_serial_numbers_of_three(texts: list[str], expected: list[int]) -> None:
    assert serial_numbers(texts, 3) == expected


@pytest.mark.parametrize(
    "texts", [["1,2"], ["1,1,2"], ["-1"], ["x"], ["4294967295"], ["1,2,3,4"], ["9" * 99]]
)
def test_serial_numbers_that_are_refused(texts: list[str]) -> None:
    with pytest.raises(BadInput, match="serial"):
        serial_numbers(texts, 3)


def test_simulate_hands_over_serial_numbers(bench: Bench) -> None:
    assert hil("simulate", "--bus", "hub:a", "--node", "unconfigured:2", "--serial", "7").exit_code == 0
    assert (bench.asked["nodes"], bench.asked["serials"]) == ([255, 255], [7, 8])


def test_version_and_help() -> None:
    assert hil("--version").stdout.startswith("servobench ")
    for command in (["--help"], ["run", "--help"], ["simulate", "--help"], ["doctor", "--help"]):
        assert hil(*command).exit_code == 0


def test_the_plug_in_costs_the_tests_of_other_projects_three_modules() -> None:
    program = (
        "import sys, pytest; before = set(sys.modules); import servobench.hil.pytest_plugin; "
        "print(*sorted(set(sys.modules) - before))"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["servobench", "servobench.hil", "servobench.hil.pytest_plugin"]


def test_help_loads_nothing_heavy() -> None:
    heavy = {"numpy", "pydantic", "rerun", "can", "canopen", "scipy"}
    program = f"import sys, servobench.hil.cli; print(sorted({heavy!r} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
