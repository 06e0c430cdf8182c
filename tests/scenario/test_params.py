"""``hil params``: what a drive holds, in a file and back, beside an SDO client and readers of DCF that share
nothing with it."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from canopen.objectdictionary import import_od

from tests.rehearsals.rehearsal import made_sheet
from tests.scenario.processes import hub_name, quiet_environment, simulated_drive
from tests.warm.start import hil
from tests.witness.frames import NodeListener
from tests.witness.witness import Key, Witness, described

pytestmark = pytest.mark.xdist_group("real time")

NODE = 5
AT_THE_MOMENT = (0x1003, 0x1010, 0x1011, 0x1013, 0x6040, 0x6042, 0x6060, 0x6071, 0x607A, 0x60C1, 0x60FF)
"""Writable, and no parameters."""


def run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [*hil(), "params", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=quiet_environment(), timeout=120)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_sheet(["2100h:01 a serial number"], tmp_path_factory.mktemp("sheet"))


@pytest.fixture(scope="module")
def bus(sheet: Path) -> Iterator[str]:
    name = hub_name("params")
    with simulated_drive(name, "--node", str(NODE), "--eds", str(sheet)):
        yield name


@pytest.fixture(scope="module")
def saved(bus: str, sheet: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the command told, with the frames of the bus."""
    path = tmp_path_factory.mktemp("saved") / "drive.dcf"
    with Witness(bus.removeprefix("hub:"), NODE) as witness:
        held = witness.readings(described(sheet))
        done: list[subprocess.CompletedProcess[str]] = []

        def going() -> Iterator[bool]:
            yield True
            done.append(run("save", path, "--bus", bus, "--node", NODE, "--eds", sheet, "--json"))
            yield False

        frames = list(witness.frames_while(going()))
    told = json.loads(done[0].stdout)
    return {"path": path, "held": held, "frames": frames, "status": done[0].returncode, "told": told}


def values_in(path: Path) -> dict[Key, bytes]:
    """Parameter values as python-canopen reads them."""
    found = {}
    for entry in import_od(str(path), NODE).values():
        members = entry.subindices.values() if hasattr(entry, "subindices") else [entry]
        for each in members:
            if getattr(each, "value_raw", None) is not None:
                found[each.index, each.subindex] = each.encode_raw(each.value)
    return found


def test_a_saved_file_has_each_parameter_as_another_client_reads_it(
    saved: dict[str, Any], sheet: Path
) -> None:
    expected = {
        key: saved["held"][key]
        for key, variable in described(sheet).items()
        if variable.readable and variable.writable and key[0] not in AT_THE_MOMENT and key in saved["held"]
    }
    found = values_in(saved["path"])
    assert found.keys() == expected.keys()
    assert {key: value for key, value in found.items() if value != expected[key]} == {}
    assert saved["told"]["parameters"] == len(expected) > 100
    assert saved["status"] == (1 if saved["told"]["refused"] else 0)


def test_saving_writes_nothing_to_the_drive(saved: dict[str, Any]) -> None:
    accesses = list(NodeListener(NODE, {}).accesses(saved["frames"]))
    assert len(accesses) > 100
    assert [access for access in accesses if access.writes] == []


def test_a_drive_made_of_the_saved_file_holds_the_same(
    saved: dict[str, Any], sheet: Path, tmp_path: Path
) -> None:
    again, name = tmp_path / "again.bin", hub_name("params-again")
    with simulated_drive(name, "--node", str(NODE), "--eds", str(saved["path"])):
        run("save", again, "--bus", name, "--node", NODE, "--eds", sheet)
        same = run("diff", saved["path"], "--bus", name, "--node", NODE)
    assert (same.returncode, same.stdout.splitlines()[0].split(" parameters")[0]) == (
        0,
        f"0 of {saved['told']['parameters']}",
    )
    assert run("diff", saved["path"], again, "--eds", sheet).returncode == 0


def test_what_differs_is_named_with_both_values(saved: dict[str, Any], bus: str, tmp_path: Path) -> None:
    text = saved["path"].read_text()
    at = text.index("ParameterValue", text.index("[6072]"))
    line = text[at : text.index("\n", at)]
    other = tmp_path / "other.dcf"
    other.write_text(text[:at] + "ParameterValue=0x123" + text[at + len(line) :])
    for words in ((other, saved["path"]), (other, "--bus", bus, "--node", NODE)):
        done = run("diff", *words, "--json")
        told = json.loads(done.stdout)
        assert done.returncode == 1
        (difference,) = told["differences"]
        assert difference["object"] == "6072h:00"
        assert (difference["first"], difference["second"]) == ("0x123", line.partition("=")[2])
        assert difference["name"] in run("diff", *words).stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["diff", "{sheet}", "{saved}"],
            "ParameterValue: found 'none', expected a DCF or XDC with parameter",
        ),
        (["diff", "{saved}"], "SECOND.dcf: found 'FIRST.dcf alone', expected a second file, or --bus and"),
        (["diff", "{saved}", "--node", "5"], "SECOND.dcf: found '--node', expected a second file, or"),
        (["diff", "{saved}", "{saved}", "--bus", "hub:x", "--node", "5"], "expected a second file, or --bus"),
        (
            ["save", "{saved}", "--bus", "hub:x", "--node", "5", "--eds", "{sheet}"],
            "expected a file that is not there yet",
        ),
    ],
)
def test_what_cannot_be_compared_or_kept_is_refused(
    saved: dict[str, Any], sheet: Path, words: list[str], said: str
) -> None:
    before = saved["path"].read_bytes()
    done = run(*(word.format(sheet=sheet, saved=saved["path"]) for word in words))
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr
    assert saved["path"].read_bytes() == before


def test_a_sheet_or_file_of_another_device_is_refused(
    saved: dict[str, Any], bus: str, sheet: Path, tmp_path: Path
) -> None:
    text = sheet.read_text()
    at = text.index("ProductNumber")
    number = text[at : text.index("\n", at)].partition("=")[2]
    stranger = tmp_path / "stranger.eds"
    stranger.write_text(text.replace(number, "0x12345678"))
    kept = tmp_path / "kept.dcf"
    done = run("save", kept, "--bus", bus, "--node", NODE, "--eds", stranger)
    assert (done.returncode, kept.exists()) == (3, False), done.stderr
    assert "is of another device: product 12345678h" in done.stderr
    theirs = tmp_path / "theirs.dcf"
    mine = saved["path"].read_text()
    at = mine.index("ProductNumber")
    product = mine[at : mine.index("\n", at)].partition("=")[2]
    theirs.write_text(mine.replace(f"={product}\n", "=305419896\n").replace(number, "0x12345678"))
    done = run("diff", saved["path"], theirs)
    assert (done.returncode, "1018h product code: found '12345678h" in done.stderr) == (2, True), done.stderr


def test_a_node_that_is_not_there_is_told_and_no_file_is_left(bus: str, sheet: Path, tmp_path: Path) -> None:
    done = run("save", tmp_path / "none.dcf", "--bus", bus, "--node", 9, "--eds", sheet)
    assert (done.returncode, list(tmp_path.iterdir())) == (3, []), done.stderr
