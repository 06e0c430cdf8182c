"""``hil params load`` and ``clone`` on the hub, killed and gone on with, by the word of a third party."""

import json
import math
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.rehearsals.rehearsal import made_sheet
from tests.scenario.processes import hub_name, in_background, quiet_environment, simulated_drive
from tests.warm.start import hil
from tests.witness.frames import NodeListener
from tests.witness.witness import Key, Witness, described

pytestmark = pytest.mark.xdist_group("real time")

NODE, OTHER = 5, 6
SHOWN: dict[Key, str] = {(0x6072, 0): "0x190", (0x6080, 0): "0x65", (0x1017, 0): "0x7B", (0x1801, 1): "0x6A5"}


def run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [*hil(), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=quiet_environment(), timeout=300)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_sheet(["2100h:01 a serial number"], tmp_path_factory.mktemp("sheet"))


@pytest.fixture(scope="module")
def bus(sheet: Path) -> Iterator[str]:
    name = hub_name("load")
    with simulated_drive(name, "--node", f"{NODE},{OTHER}", "--eds", str(sheet)):
        yield name


@pytest.fixture(scope="module")
def changed(bus: str, sheet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The saved file with other values."""
    path = tmp_path_factory.mktemp("saved") / "drive.dcf"
    done = run("params", "save", path, "--bus", bus, "--node", NODE, "--eds", sheet)
    assert done.returncode == 0, done.stderr
    text = path.read_text()
    for (index, sub), value in SHOWN.items():
        section = f"{index:04X}sub{sub}" if index < 0x6000 and sub else f"{index:04X}"
        at = text.index("ParameterValue", text.index(f"[{section}]"))
        text = f"{text[:at]}ParameterValue={value}{text[text.index(chr(10), at) :]}"
    path.write_text(text)
    return path


def held(bus: str, sheet: Path, node: int) -> dict[Key, bytes]:
    variables = {key: each for key, each in described(sheet).items() if each.writable and key[0] != 0x1013}
    with Witness(bus.removeprefix("hub:"), node) as witness:
        return witness.readings(variables)


@pytest.mark.parametrize("way", ["gone on with", "undone"])
def test_after_a_kill_a_load_goes_on_or_is_undone_to_the_byte(
    bus: str, sheet: Path, changed: Path, tmp_path: Path, way: str
) -> None:
    before = held(bus, sheet, NODE)
    load = ["params", "load", changed, "--bus", bus, "--node", NODE, "--out", tmp_path / "out"]
    process = in_background([*hil(), *map(str, load)])
    listener = NodeListener(NODE, {})

    def going() -> Iterator[bool]:
        while process.poll() is None:
            yield True
        yield False

    with Witness(bus.removeprefix("hub:"), NODE) as witness:
        for frame in witness.frames_while(going()):
            if any(access.writes for access in listener.accesses([frame])):
                process.kill()
    process.communicate()
    journal = tmp_path / "out" / "journal.jsonl"
    if way == "gone on with":
        done = run(*load, "--json")
        assert (done.returncode, json.loads(done.stdout)["refused"]) == (0, {}), done.stderr
        now = held(bus, sheet, NODE)
        assert {key: now[key] for key in SHOWN} == {
            key: int(value, 0).to_bytes(len(before[key]), "little") for key, value in SHOWN.items()
        }
        assert {key for key in now if now[key] != before[key]} == SHOWN.keys()
    done = run("restore", journal)
    assert (done.returncode, "byte for byte" in done.stderr + done.stdout) == (0, True), done.stderr
    assert held(bus, sheet, NODE) == before


def test_a_clone_holds_the_same_but_what_is_of_its_node(bus: str, sheet: Path, tmp_path: Path) -> None:
    clone = ["params", "clone", "--bus", bus, "--node", NODE, "--to", OTHER, "--eds", sheet]
    changed = run("params", "load", tmp_path / "none.dcf", "--bus", bus, "--node", OTHER)
    assert changed.returncode == 2
    done = run(*clone, "--out", tmp_path, "--store", "--json")
    figures = json.loads(done.stdout)
    assert (done.returncode, figures["refused"], figures["stored"]) == (0, {}, True), done.stderr
    mine, theirs = held(bus, sheet, NODE), held(bus, sheet, OTHER)
    other = {key for key in mine if mine[key] != theirs[key]}
    assert {key[0] for key in other} <= {0x1014, *range(0x1400, 0x1404), *range(0x1800, 0x1804), 0x2100}
    assert all(int.from_bytes(theirs[key], "little") & 0x7F == OTHER for key in other if key[0] < 0x2000)
    assert run(*clone[:-4], "--to", NODE, "--eds", sheet).returncode == 2


def test_two_drives_are_compared_by_name_and_unit(bus: str, sheet: Path, tmp_path: Path) -> None:
    saved = tmp_path / "other.dcf"
    assert run("params", "save", saved, "--bus", bus, "--node", OTHER, "--eds", sheet).returncode == 0
    text = saved.read_text()
    for section, value in (("6072", "0x1F4"), ("6080", "0x64"), ("6083", "0x3E8"), ("1017", "0xC8")):
        at = text.index("ParameterValue", text.index(f"[{section}]"))
        text = f"{text[:at]}ParameterValue={value}{text[text.index(chr(10), at) :]}"
    saved.write_text(text)
    out = tmp_path / "out"
    load = ["params", "load", saved, "--bus", bus, "--node", OTHER, "--out", out, "--store"]
    assert run(*load).returncode == 0
    compared = ["params", "diff", sheet, "--bus", bus, "--node", NODE, "--other", OTHER]
    done = run(*compared, "--json")
    figures = json.loads(done.stdout)
    assert (done.returncode, figures["first"][:6], figures["second"][:6]) == (1, "node 5", "node 6")
    told = {
        each["object"]: (each["name"], each["second"], each["second_si"]) for each in figures["differences"]
    }
    with Witness(bus.removeprefix("hub:"), OTHER) as witness:
        rated = witness.read(0x6076, 0) or b""
    torque_nm = int.from_bytes(rated, "little") * 1e-3 * 0.5
    assert told["6072h:00"] == ("Max torque", "0x1F4", f"{torque_nm:.6g} N m")
    assert told["6080h:00"][1:] == ("0x64", f"{100 * math.tau / 60:.6g} rad/s")
    assert told["1017h:00"][1:] == ("0xC8", "0.2 s")
    assert told["6083h:00"][2].endswith(" rad/s^2")
    assert told.keys() == {"6072h:00", "6080h:00", "6083h:00", "1017h:00"}
    assert f"0x1F4 ({torque_nm:.6g} N m)" in run(*compared).stdout
    same = run("params", "diff", saved, "--bus", bus, "--node", OTHER, "--json")
    assert (same.returncode, json.loads(same.stdout)["differences"]) == (0, [])
    assert run(*compared[:-1], NODE).returncode == 2
    done = run("restore", out / "journal.jsonl", "--store", "--json")
    assert (done.returncode, json.loads(done.stdout)["stored"]) == (0, True), done.stderr
    with Witness(bus.removeprefix("hub:"), OTHER) as witness:
        witness.reset()
    assert run(*compared).returncode == 0  # what follows the node-ID is no difference


def test_what_cannot_be_loaded_is_refused(bus: str, changed: Path, sheet: Path, tmp_path: Path) -> None:
    text = changed.read_text()
    at = text.index("ProductNumber")
    number = text[at : text.index("\n", at)].partition("=")[2]
    theirs = text.replace(f"={number}\n", "=305419896\n").replace(f"0x{int(number):X}", "0x12345678")
    (tmp_path / "theirs.dcf").write_text(theirs)
    done = run("params", "load", tmp_path / "theirs.dcf", "--bus", bus, "--node", NODE, "--out", tmp_path)
    assert (done.returncode, "is of another device: product code" in done.stderr) == (3, True), done.stderr
    done = run("params", "load", sheet, "--bus", bus, "--node", NODE, "--out", tmp_path)
    assert (done.returncode, "expected a DCF or XDC with parameter values" in done.stderr) == (2, True)
    assert not (tmp_path / "journal.jsonl").exists()
