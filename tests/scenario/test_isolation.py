"""What lies in a user's folder is neither imported by servobench nor in its way, whatever it is called."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from servobench.virtual_bus.child_python import python_command, python_environment

ROOT = Path(__file__).parents[2]
EXECUTED = "executed"
"""What a module in the user's folder leaves there when it is imported."""
EXAMPLE = ROOT / "examples" / "ling2012.toml"
JOIN = "from servobench.virtual_bus.bus.hub import HubBus; HubBus('isolation').shutdown()"


@pytest.fixture(scope="module")
def forked_children() -> None:
    """What a process imports is for one that is started to show."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One that holds modules by the names of the standard library's and of ours."""
    found = tmp_path / "user"
    for name in ("random.py", "json.py", "drivers/__init__.py", "design/__init__.py", "hil/__init__.py"):
        module = found / name
        module.parent.mkdir(parents=True, exist_ok=True)
        module.write_text(f"open({str(found / EXECUTED)!r}, 'w')\n")
    return found


def said_in(folder: Path, command: list[str], **added: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **added}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=100, check=False
    )


@pytest.mark.parametrize("path", [str(ROOT), f".:{ROOT}:"])
def test_the_environment_of_a_child_holds_our_root_and_not_the_users_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", path)
    program = "import sys, random, servobench.hil.cli; print(*sys.path, servobench.__file__, sep='\\n')"
    command = [*python_command("x")[:2], "-c", program]
    child = subprocess.run(command, env=python_environment(), capture_output=True, text=True, check=True)
    *places, package = child.stdout.splitlines()
    assert Path(package).parents[1] == ROOT
    assert str(folder) not in places
    assert "" not in places
    assert not (folder / EXECUTED).exists()


def test_other_entries_of_pythonpath_stay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    monkeypatch.setenv("PYTHONPATH", f"user:{ROOT}:/elsewhere/python")
    assert python_environment(A="b")["PYTHONPATH"].split(":") == [str(ROOT), str(folder), "/elsewhere/python"]
    assert python_environment(A="b")["A"] == "b"


def test_the_logger_imports_nothing_of_the_users_folder_and_not_pandas(folder: Path, tmp_path: Path) -> None:
    text = EXAMPLE.read_text().replace("duration_s = 2.0", "duration_s = 0.02").split("[[reference", 1)[0]
    bench = tmp_path / "short.toml"
    bench.write_text(text.replace('"motors/', f'"{EXAMPLE.parent}/motors/').split("[faults]", 1)[0])
    command = [
        sys.executable,
        "-P",
        "-m",
        "servobench.hil.cli",
        "run",
        str(bench),
        "--record",
        str(tmp_path / "run"),
    ]
    found = said_in(folder, command, PYTHONPROFILEIMPORTTIME="1")
    assert found.returncode in (0, 1), found.stderr
    imported = (tmp_path / "run" / "logger.log").read_text()
    assert " rerun" in imported
    assert " pandas." not in imported
    assert (tmp_path / "run" / "summary.json").stat().st_size
    assert not (folder / EXECUTED).exists()


def test_the_broker_of_a_hub_imports_nothing_of_the_users_folder(folder: Path, tmp_path: Path) -> None:
    runtime = tmp_path / "run"
    runtime.mkdir(mode=0o700)
    found = said_in(folder, [sys.executable, "-P", "-c", JOIN], XDG_RUNTIME_DIR=str(runtime))
    assert found.returncode == 0, found.stderr
    assert not (folder / EXECUTED).exists()


NAMES = [
    "app", "bench", "bus", "config", "controllers", "core", "design", "devices", "drivers", "helpers", "hil",
    "lib", "models", "motor", "plots", "scripts", "tests", "tools", "utils", "virtual_bus",
]  # fmt: skip
"""Common names of folders and modules in a lab's repository, those of our own folders among them."""
THEIRS = """
import {names}

assert [each.HERE for each in ({names})] == {quoted}

"""
SCRIPT = """
from servobench import run

print(run("bench.toml").verdict.outcome)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which the wheel is installed, not compiled: which names it takes is the same."""
    folder = tmp_path_factory.mktemp("installed")
    wheels, copy = folder / "wheels", folder / "copy"
    left_out = shutil.ignore_patterns(
        ".*", "build", "dist", "runs", "tests", "docs", "*.egg-info", "__pycache__"
    )
    shutil.copytree(ROOT, copy, symlinks=True, ignore=left_out)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels), str(copy)]
    subprocess.run(build, check=True, env={**os.environ, "SERVOBENCH_PURE": "1"}, capture_output=True)
    (wheel,) = wheels.iterdir()
    target = folder / "packages"
    zipfile.ZipFile(wheel).extractall(target)
    return target


def test_folders_and_files_of_common_names_are_in_nobody_s_way(installed: Path, tmp_path: Path) -> None:
    for number, name in enumerate(NAMES):
        module = tmp_path / (f"{name}/__init__.py" if number % 2 else f"{name}.py")
        module.parent.mkdir(exist_ok=True)
        module.write_text(f'HERE = "{name}"\n')
    place = {"PYTHONPATH": f"{tmp_path}:{installed}"}
    hil = [sys.executable, "-c", "from servobench.hil.cli import main; main()"]
    assert said_in(tmp_path, [*hil, "init"], **place).returncode == 0
    (tmp_path / "script.py").write_text(SCRIPT)
    theirs = THEIRS.format(names=", ".join(NAMES), quoted=NAMES)
    for name in ("controller.py", "script.py", "test_controller.py"):
        file = tmp_path / name
        file.write_text(theirs + file.read_text())
    for command in (
        [*hil, "run", "bench.toml", "--no-record"],
        [sys.executable, "script.py"],
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
    ):
        done = said_in(tmp_path, command, **place)
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
