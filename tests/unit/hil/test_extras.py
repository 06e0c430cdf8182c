"""What runs without the packages that come with extras, and what is said where one is missing."""

import json
import os
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import servobench
from servobench.hil.machine.extras import EXTRAS, MissingExtra, is_installed, missing_extra
from servobench.hil.machine.held_process import OWN_FILES
from servobench.hil.restoring.journal import DriveMark, Journal, JournalHead

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HIDE = """
import sys

class Without:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Without())
"""
EACH = """
import json, os, sys, tempfile
import can, canopen, numpy, pydantic, rich.console
from servobench.hil.cli import main

told = []
for line in sys.argv[1:]:
    with tempfile.TemporaryFile("w+") as said:
        child = os.fork()
        if not child:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
            sys.argv = ["hil", *line.split()]
            main()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said.seek(0)
        told.append((status, said.read()))
print(json.dumps(told))
"""
"""Each command line in a process that is forked off where the command itself is imported, and packages that
every bench has."""
PLATE = """
[motor]
resistance_ohm = 0.1
inductance_d_h = 0.0007
inductance_q_h = 0.0009
pole_pairs = 3
ke_line_vrms_krpm = 10.0

[rating]
torque_nm = 1.8
speed_rpm = 1700
current_a = 10.9
dc_bus_voltage_v = 48.0
"""


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fresh bench in which no process finds a package of an extra."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "sitecustomize.py").write_text(HIDE.format(names=set(EXTRAS)), encoding="utf-8")
    assert hil(folder, "init", "mybench").returncode == 0
    (folder / "mybench" / "plate.toml").write_text(PLATE, encoding="utf-8")
    return folder


def hil(
    folder: Path, *words: str, module: str = "servobench.hil.cli", within: str = ""
) -> subprocess.CompletedProcess[str]:
    return python(folder / within, folder, "-m", module, *words)


def hil_each(folder: Path, *lines: str) -> list[tuple[int, str]]:
    """Status and words of each command line, in the folder of the bench."""
    done = python(folder / "mybench", folder, "-c", EACH, *lines)
    assert done.returncode == 0, done.stderr
    return [(status, words) for status, words in json.loads(done.stdout)]


def python(within: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        cwd=within,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )


def test_each_package_stands_in_its_extra_and_all_brings_them_together() -> None:
    extras = {
        name: {Requirement(each).name for each in needed}
        for name, needed in PROJECT["optional-dependencies"].items()
    }
    distributions = packages_distributions()
    for package, extra in EXTRAS.items():
        assert set(distributions[package]) & extras[extra], package
    assert {"scipy", "matplotlib"} <= extras["campaign"]
    [everything] = PROJECT["optional-dependencies"]["all"]
    assert Requirement(everything).extras == set(extras) - {"all"}
    core = {Requirement(each).name for each in PROJECT["dependencies"]}
    assert not core & set().union(*(names for name, names in extras.items() if name != "all"))


@pytest.mark.long
def test_a_bench_runs_and_its_recording_lacks_the_page_alone(core: Path) -> None:
    done = hil(core, "run", "bench.toml", "--record", "run", "--json", within="mybench")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("run.rrd needs the extra view") == 1
    assert not json.loads(done.stdout).get("recording_faults")
    kept = {path.name for path in (core / "mybench" / "run").iterdir()}
    assert {"records.arrow", "frames.arrow", "events.jsonl", "summary.json", "seal"} <= kept
    assert "run.rrd" not in kept
    lines = "review run", "runs .", "compare run run", "trace run --to 0.01", "export run --to csv"
    for line, (status, words) in zip(lines, hil_each(core, *lines), strict=True):
        assert status == 0, (line, words)
    each_says(
        core,
        {
            "view run": "view",
            "run bench.toml --view": "view",
            "compare run run --rrd both.rrd": "view",
            "picture run page.png": "view",
            "review run --report report.html": "report",
            "export run --to mf4": "mf4",
            "export run --to mat": "design",
        },
    )


@pytest.mark.long
def test_the_fixtures_of_pytest_run_a_bench(core: Path) -> None:
    done = hil(core, "-q", "-p", "no:cacheprovider", module="pytest", within="mybench")
    assert done.returncode == 0, done.stdout
    (core / "test_sweep.py").write_text(
        "def test_it(servo_campaign): servo_campaign('sweep.toml')\n", "utf-8"
    )
    done = hil(core, "-q", "-p", "no:cacheprovider", "test_sweep.py", module="pytest")
    assert "the fixture servo_campaign needs the extra campaign (scipy is not installed)" in done.stdout
    assert "pip install 'servobench[campaign]'" in done.stdout


@pytest.mark.long
def test_a_command_says_which_extra_it_lacks(core: Path) -> None:
    each_says(
        core,
        {
            "design hinf motor.toml": "design",
            "design speed motor.toml --delay-ms 2 --error-percent 10": "design",
            "analyse speed motor.toml --gain 0.01,0.01 --delay-ms 2": "design",
            "measure --bus hub:nobody --node 1": "design",
            "campaign run sweep.toml": "campaign",
            "reproduce ling2012": "design",
            "commission --bus hub:nobody --node 1 --motor plate.toml --out dry --yes": "design",
        },
    )


@pytest.mark.long
def test_a_drive_is_put_back_without_an_extra(core: Path) -> None:
    head = JournalHead("hub:nobody", 7, DriveMark(0x1A, 0x2B, 3), None, None)
    Journal(core / "journal.jsonl", head).close()
    done = hil(core, "restore", "journal.jsonl")
    assert (done.returncode, "node 7 on hub:nobody did not answer" in done.stderr) == (3, True), done.stderr


def each_says(core: Path, extra_of: dict[str, str]) -> None:
    told = hil_each(core, *extra_of)
    for (line, extra), (status, words) in zip(extra_of.items(), told, strict=True):
        assert status == 2, (line, words)
        assert f"needs the extra {extra} (" in words, (line, words)
        assert f"pip install 'servobench[{extra}]'" in words


def test_a_module_of_the_users_own_that_is_missing_is_no_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModuleNotFoundError) as raised:
        import_module("no_such_module")
    error = raised.value
    assert missing_extra(error) is None
    error.name = "scipy.linalg"
    assert isinstance(missing_extra(error), MissingExtra)
    monkeypatch.setattr("servobench.hil.machine.extras.OWN_FILES", {*OWN_FILES, __file__})
    assert missing_extra(error) is None
    assert missing_extra(OSError("scipy")) is None
    assert not is_installed("no_such_module")


def test_from_python_the_extra_is_named_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "servobench.hil.campaign.campaign", raising=False)
    monkeypatch.delitem(sys.modules, "servobench.hil.campaign.plan", raising=False)
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    with pytest.raises(MissingExtra, match=r"servobench campaign needs the extra campaign \(scipy"):
        _ = servobench.campaign


@pytest.mark.long
def test_a_run_that_writes_no_files_loads_neither_arrow_nor_an_extra() -> None:
    program = (
        "import sys; from servobench.hil.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'pyarrow', 'rerun', 'scipy', 'matplotlib'} & set(sys.modules)), file=sys.stderr)"
    )
    command = [
        sys.executable,
        "-c",
        program,
        "run",
        str(ROOT / "examples" / "position_csp.toml"),
        "--no-record",
    ]
    assert subprocess.run(command, capture_output=True, text=True).stderr.splitlines()[-1] == "[]"


def test_the_logger_of_a_run_loads_neither_canopen_nor_python_can() -> None:
    program = (
        "import sys, servobench.hil.recording.logger; print(sorted({'can', 'canopen'} & set(sys.modules)))"
    )
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "[]\n"
