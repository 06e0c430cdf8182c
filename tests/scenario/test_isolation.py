"""A folder of the user's is neither imported by a process of ours, nor taken for a package of ours."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hil.terminal.hidden_rooms import ROOMS, ROOT, hidden_room
from virtual_bus.child_python import python_command, python_environment

EXECUTED = "executed"
"""What a module in the user's folder leaves there when it is imported."""
EXAMPLE = ROOT / "examples" / "ling2012.toml"
JOIN = "from virtual_bus.bus.hub import HubBus; HubBus('isolation').shutdown()"


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


@pytest.mark.parametrize("path", [str(ROOT), f"{ROOT}:", f":{ROOT}", f".:{ROOT}"])
def test_the_environment_of_a_child_holds_our_root_and_not_the_users_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", path)
    program = "import sys, drivers, hil, random; print(*sys.path, drivers.__file__, sep='\\n')"
    command = [*python_command("x")[:2], "-c", program]
    child = subprocess.run(command, env=python_environment(), capture_output=True, text=True, check=True)
    *places, drivers = child.stdout.splitlines()
    assert Path(drivers).parents[1] == ROOT
    assert str(folder) not in places
    assert "" not in places
    assert not (folder / EXECUTED).exists()


def test_other_entries_of_pythonpath_stay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    monkeypatch.setenv("PYTHONPATH", f"user:{ROOT}:/elsewhere/python")
    assert python_environment(A="b")["PYTHONPATH"].split(":") == [str(ROOT), str(folder), "/elsewhere/python"]
    assert python_environment(A="b")["A"] == "b"


def test_the_logger_imports_nothing_of_the_users_folder(folder: Path, tmp_path: Path) -> None:
    text = EXAMPLE.read_text().replace("duration_s = 2.0", "duration_s = 0.02").split("[[reference", 1)[0]
    bench = tmp_path / "short.toml"
    bench.write_text(text.replace('"motors/', f'"{EXAMPLE.parent}/motors/').split("[faults]", 1)[0])
    command = [sys.executable, "-P", "-m", "hil.cli", "run", str(bench), "--record", str(tmp_path / "run")]
    found = said_in(folder, command)
    assert found.returncode in (0, 1), found.stderr
    assert (tmp_path / "run" / "summary.json").stat().st_size
    assert not (folder / EXECUTED).exists()


def test_the_broker_of_a_hub_imports_nothing_of_the_users_folder(folder: Path, tmp_path: Path) -> None:
    runtime = tmp_path / "run"
    runtime.mkdir(mode=0o700)
    found = said_in(folder, [sys.executable, "-P", "-c", JOIN], XDG_RUNTIME_DIR=str(runtime))
    assert found.returncode == 0, found.stderr
    assert not (folder / EXECUTED).exists()


@pytest.mark.parametrize("room", ROOMS)
def test_a_hidden_room_is_named_in_one_line(tmp_path: Path, room: str) -> None:
    (tmp_path / room).mkdir()
    (tmp_path / room / "__init__.py").touch()
    command = [sys.executable, "-P", "-m", "hil.cli", "run", str(EXAMPLE)]
    path = f"{tmp_path}:{ROOT}"
    plain = said_in(tmp_path, command, PYTHONPATH=path)
    with_object = said_in(tmp_path, [*command, "--json"], PYTHONPATH=path)
    for found in (plain, with_object):
        assert found.returncode == 2
        assert found.stderr.count("\n") == 1
        assert str(tmp_path / room) in found.stderr
        assert f"hides the package {room!r}" in found.stderr
    assert plain.stdout == ""
    verdict = json.loads(with_object.stdout)["verdict"]
    assert (verdict["outcome"], verdict["exit_status"]) == ("bad input", 2)
    assert f"hides the package {room!r}" in verdict["reason"]


@pytest.mark.parametrize("hiding", ["drivers/__init__.py", "design.py", "virtual_bus/mine.py"])
def test_a_script_beside_a_hiding_folder_is_told_which_and_what_to_do(tmp_path: Path, hiding: str) -> None:
    (tmp_path / hiding).parent.mkdir(exist_ok=True)
    (tmp_path / hiding).touch()
    script = tmp_path / "bench.py"
    script.write_text("from hil import run\nprint(run)\n")
    found = said_in(tmp_path, [sys.executable, str(script)])
    if hiding == "virtual_bus/mine.py":  # without __init__.py it is a package only where no other is found
        assert found.returncode == 0, found.stderr
        return
    room = Path(hiding).parts[0].removesuffix(".py")
    assert found.stderr.splitlines()[-1].startswith("ImportError: ")
    assert f"hides the package {room!r} of servobench" in found.stderr.splitlines()[-1]
    assert str(tmp_path / room) in found.stderr.splitlines()[-1]
    assert "rename it" in found.stderr


def test_no_room_is_hidden_here() -> None:
    assert hidden_room() is None
    assert "hides" in (hidden_room(Path("/nowhere")) or "")


def test_pytest_names_it_for_the_test_that_asks_for_a_fixture(tmp_path: Path) -> None:
    (tmp_path / "drivers").mkdir()
    (tmp_path / "drivers" / "__init__.py").touch()
    (tmp_path / "test_it.py").write_text(
        "def test_drive(servo_drive): servo_drive()\ndef test_other(): pass\n"
    )
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", "."]
    found = said_in(tmp_path, command, PYTHONPATH=f"{tmp_path}:{ROOT}")
    assert "1 passed" in found.stdout
    assert f"{tmp_path / 'drivers'}: hides the package 'drivers'" in found.stdout
