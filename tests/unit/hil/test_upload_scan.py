"""Parameters of drives without a data sheet: beside what the drive's dictionary holds."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.canopen.write_list import NOTHING
from servobench.drivers.errors import BadInput, NoAnswer
from servobench.hil.cli import app
from servobench.hil.inspecting.loading import LoadRequest, load_parameters
from servobench.hil.inspecting.parameters import (
    ParameterSet,
    configuration_text,
    differences,
    for_node,
    parameters_of,
    read_parameters,
)
from servobench.virtual_bus.device.object_dictionary import Access
from tests.parameters.roundtrip import NODE, RATE, Bench, MortalHost, on_a_bench
from tests.rehearsals.rehearsal import made_sheet
from tests.witness.witness import Key

RANGES: Final = (
    range(0x1000, 0x1020),
    range(0x1800, 0x1804),
    range(0x2100, 0x2120),
    range(0x2310, 0x2320),
    range(0x6060, 0x6100),
)
MAKERS: Final[dict[Key, tuple[DataType, float | bytes]]] = {
    (0x2310, 0): (DataType.UNSIGNED8, NODE),
    (0x2311, 0): (DataType.INTEGER16, -2),
    (0x2312, 0): (DataType.REAL32, 1.5),
    (0x2313, 0): (DataType.VISIBLE_STRING, b"a name"),
    (0x2314, 0): (DataType.OCTET_STRING, b"\1\0\3"),
    (0x2315, 0): (DataType.UNSIGNED64, 1 << 40),
}


class Host(MortalHost):
    """Does something before it reads an object."""

    before: dict[Key, Callable[[], None]]
    asked: list[Key]

    def upload(
        self, node_id: int, index: int, sub: int = 0, timeout_s: float | None = None, attempts: int = 3
    ) -> bytes:
        self.asked.append((index, sub))
        self.before.get((index, sub), bool)()
        return super().upload(node_id, index, sub, timeout_s, attempts)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_sheet(["2100h:01 a serial number"], tmp_path_factory.mktemp("sheet"))


@pytest.fixture(scope="module")
def bench(sheet: Path) -> Iterator[Bench]:
    with on_a_bench(sheet) as bench:
        for (index, _), (kind, value) in MAKERS.items():
            bench.drive.dictionary.add(index, "?", kind, default=value)
        bench.drive.dictionary.add(0x2316, "?", DataType.UNSIGNED8, Access.WRITE_ONLY)
        yield bench


def scanned(
    bench: Bench, before: dict[Key, Callable[[], None]] | None = None, path: Path | None = None
) -> tuple[ParameterSet, list[str], Host]:
    host, told = Host(bench.world.link, bench.world.clock, NOTHING), list[str]()
    host.before, host.asked = before or {}, []
    read, dictionary, identity = read_parameters(host, NODE, None, "simulated", told.append, RANGES)
    if path is not None:
        path.write_text(configuration_text(read, dictionary, identity, RATE))
    return read, told, host


def test_every_parameter_is_found_with_its_bytes_and_comes_back_from_a_file(
    bench: Bench, sheet: Path, tmp_path: Path
) -> None:
    read, told, host = scanned(bench, path=tmp_path / "asked.dcf")
    in_ranges = {key for key in bench.keys if any(key[0] in each for each in RANGES)}
    held = {key: value for key, value in bench.held().items() if key in in_ranges}
    assert len(held) > 60
    assert {key: read.values.get(key) for key in held} == held
    for key in MAKERS:
        assert read.values[key] == bench.drive.dictionary.upload(*key)
    assert (read.unread, host.written) == ({}, 0)
    again = parameters_of(tmp_path / "asked.dcf")
    assert dict(again.values) == dict(read.values)
    assert differences(read, again) == []
    beside = read_parameters(bench.host(), NODE, sheet, "simulated", told.append)[0]
    assert {each.place for each in differences(read, beside) if each.place in in_ranges} == set()
    assert "asking node 5 for 244 indices" in told[0]
    assert "guessed by their size" in told[1]


def test_a_type_that_nobody_told_is_said_to_be_guessed(bench: Bench) -> None:
    read, _, _ = scanned(bench)
    kinds = {key[0]: DataType(read.types[key]).name for key in MAKERS}
    assert kinds == {
        0x2310: "UNSIGNED8", 0x2311: "UNSIGNED16", 0x2312: "UNSIGNED32", 0x2313: "VISIBLE_STRING",
        0x2314: "OCTET_STRING", 0x2315: "UNSIGNED64",
    }  # fmt: skip
    assert read.names[0x2311, 0] == "2311h (UNSIGNED16 by its size)"
    assert (read.names[0x6072, 0], read.types[0x607C, 0]) == ("Max torque", DataType.INTEGER32)
    assert (0x2316, 0) not in read.values


def test_what_changes_while_it_is_looked_at_is_no_parameter(bench: Bench) -> None:
    variable = bench.drive.dictionary.variable(0x2311)

    def count() -> None:
        variable.value += 1

    read, _, _ = scanned(bench, {(0x2311, 0): count})
    variable.value = -2
    assert (0x2311, 0) not in read.values
    assert (0x2312, 0) in read.values


def test_an_object_without_an_answer_is_named_and_a_node_that_is_gone_ends_it(bench: Bench) -> None:
    gone: list[Key] = []

    def silent() -> None:
        gone.append((0x2312, 0))
        raise NoAnswer("no answer")

    def is_gone() -> None:
        if gone:
            raise NoAnswer("no answer")

    read, _, _ = scanned(bench, {(0x2312, 0): silent})
    assert dict(read.unread) == {(0x2312, 0): "not answered"}
    assert (0x2313, 0) in read.values
    gone.clear()
    with pytest.raises(NoAnswer):
        scanned(bench, {(0x2312, 0): silent, (0x1000, 0): is_gone})


def test_files_and_programs_are_not_asked_for(bench: Bench) -> None:
    _, _, host = scanned(bench)
    asked = {index for index, _ in host.asked}
    assert {0x1017, 0x1018, 0x6072} <= asked
    read_parameters(
        host, NODE, None, "simulated", lambda _: None, [range(0x1F20, 0x1F60), range(0x1021, 0x1022)]
    )
    assert not {0x1021, 0x1F22, 0x1F50} & {index for index, _ in host.asked}


def test_what_may_be_its_node_id_stays_with_it_and_read_only_ones_are_named(
    bench: Bench, tmp_path: Path
) -> None:
    read, _, _ = scanned(bench)
    moved, left = for_node(read, NODE + 1)
    assert left == {(0x2310, 0): "its own"}
    assert (0x2311, 0) in moved.values
    other = dict(read.values) | {(0x6072, 0): b"\x90\1", (0x608F, 1): b"\1\2\0\0"}
    request = LoadRequest("simulated", RATE, NODE, tmp_path)
    loaded = load_parameters(bench.host(), replace(read, values=other), request, lambda _: None)
    assert loaded.refused.keys() == {(0x608F, 1)}
    assert "06010002h" in loaded.refused[0x608F, 1]
    assert bench.drive.dictionary.upload(0x6072, 0) == b"\x90\1"
    assert bench.undo(tmp_path) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--range", "2000"], "two hexadecimal indices"),
        (["--range", "2010-2000"], "two hexadecimal indices"),
        (["--range", "0-2000"], "two hexadecimal indices"),
        (["--range", "2000-2010", "--eds", "drive.eds"], "no --eds"),
    ],
)
def test_what_is_no_range_is_refused(words: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["params", "save", "none.dcf", "--bus", "hub:x", "--node", "1", *words])
    assert (done.exit_code, said in done.output) == (BadInput.exit_status, True), done.output


def test_a_concise_file_alone_tells_no_device(tmp_path: Path) -> None:
    (tmp_path / "drive.bin").write_bytes(bytes(4))
    with pytest.raises(BadInput, match="--eds FILE of the device"):
        parameters_of(tmp_path / "drive.bin", NODE)


def test_entries_that_are_no_parameters_of_the_sheet_are_named(sheet: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    store = bytes.fromhex("1010 01 04000000") + b"save"
    path.write_bytes(b"\2\0\0\0" + store + bytes.fromhex("7260 00 02000000 9001"))
    read = parameters_of(path, NODE, sheet)
    assert (dict(read.values), list(read.unread)) == ({(0x6072, 0): b"\x90\1"}, [(0x1010, 1)])
