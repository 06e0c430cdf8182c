"""Parameters loaded into a simulated drive: what is written, refused, undone and gone on with."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.sheets.concise import read_concise
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.inspecting.loading import Loaded, LoadRequest, concise_dcf, load_parameters
from servobench.hil.inspecting.parameters import ParameterSet, for_node, read_parameters
from servobench.hil.restoring.journal import read_journal
from tests.parameters.roundtrip import NODE, RATE, Bench, MortalHost, differing, on_a_bench, tried
from tests.rehearsals.rehearsal import made_sheet
from tests.witness.witness import Key

LIMIT: Final = (0x6072, 0)
ENABLING: Final = (6, 7, 15)
"""Controlwords from switch on disabled to operation enabled (CiA 402-2)."""


def number(value: int, length: int = 4) -> bytes:
    return value.to_bytes(length, "little")


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_sheet(["2100h:01 a serial number"], tmp_path_factory.mktemp("sheet"))


@pytest.fixture(scope="module")
def world(sheet: Path) -> Iterator[Bench]:
    with on_a_bench(sheet) as bench:
        yield bench


@pytest.fixture
def bench(world: Bench) -> Bench:
    """With factory settings, disabled and at rest."""
    world.reset()
    return world


@pytest.fixture(scope="module")
def factory(world: Bench, sheet: Path) -> ParameterSet:
    world.reset()
    return read_parameters(world.host(), NODE, sheet, "simulated", lambda _: None)[0]


def changed(parameters: ParameterSet, changes: dict[Key, bytes]) -> ParameterSet:
    return replace(parameters, values={**parameters.values, **changes})


def loaded(
    bench: Bench, wanted: ParameterSet, out: Path, host: MortalHost | None = None, store: bool = False
) -> Loaded:
    request = LoadRequest("simulated", RATE, NODE, out, store)
    master = bench.host() if host is None else host
    return load_parameters(master, wanted, request, lambda _: None)


def enable(bench: Bench) -> None:
    for word in ENABLING:
        bench.drive.dictionary.download(0x6040, 0, number(word, 2))
    assert bench.drive.drive.power.state is State.OPERATION_ENABLED


def test_drawn_settings_come_back_after_a_reset_and_after_kills(sheet: Path, tmp_path: Path) -> None:
    outcome = tried(sheet, tmp_path, "a drive", 2)
    assert outcome.wrong == []
    assert (outcome.parameters > 190, outcome.kills) == (True, 2)
    assert outcome.drawn > 90


@pytest.mark.parametrize(
    ("before", "changes"),
    [
        ({(0x1006, 0): number(1000)}, {(0x1006, 0): number(1000), (0x1019, 0): b"\x0a"}),
        ({(0x1016, 1): number(0x20100), (0x1016, 2): number(0x30100)},
         {(0x1016, 1): number(0x30100), (0x1016, 2): number(0x20100)}),
        ({}, {(0x1014, 0): number(0x6A0)}),
        ({}, {(0x1800, 1): number(0x6A1), (0x1A00, 0): b"\1", (0x1A00, 1): number(0x606C0020)}),
        ({}, {(0x1A00, 0): b"\1", (0x1A00, 2): number(0x60770010)}),
    ],
    ids=["1019h wants 1006h at 0", "1016h swapped", "1014h wants bit 31", "a PDO", "an unused entry"],
)  # fmt: skip
def test_what_the_standard_wants_first_is_done_first_and_undone(
    bench: Bench, factory: ParameterSet, tmp_path: Path, before: dict[Key, bytes], changes: dict[Key, bytes]
) -> None:
    for key, value in before.items():
        bench.drive.dictionary.download(*key, value)
    found = bench.held()
    result = loaded(bench, changed(factory, changes), tmp_path)
    assert (result.refused, result.complete) == ({}, True)
    assert {key: bench.held()[key] for key in changes} == changes
    assert bench.undo(tmp_path) == []
    assert differing(found, bench.held()) == []
    (tmp_path / "drive.bin").write_bytes(concise_dcf(changed(factory, changes)))
    assert bench.manage(tmp_path / "drive.bin") == {}
    assert {key: bench.held()[key] for key in changes} == changes


def test_a_manager_is_not_given_unit_words_of_nothing(factory: ParameterSet, tmp_path: Path) -> None:
    path, words = tmp_path / "drive.bin", {(0x60A8, 0): number(0x00B50000), (0x60A9, 0): number(0)}
    path.write_bytes(concise_dcf(changed(factory, words)))
    assert {0x60A8, 0x60A9} & {entry.place[0] for entry in read_concise(path)} == {0x60A8}


def test_what_is_refused_is_named_and_the_rest_is_loaded(
    bench: Bench, factory: ParameterSet, tmp_path: Path
) -> None:
    wanted = changed(factory, {(0x1005, 0): number(0x40000081), LIMIT: number(400, 2), (0x5FFF, 0): b"\1"})
    wanted = replace(wanted, types={**wanted.types, (0x5FFF, 0): 5}, names={**wanted.names, (0x5FFF, 0): "?"})
    result = loaded(bench, wanted, tmp_path)
    assert result.refused.keys() == {(0x1005, 0), (0x5FFF, 0)}
    assert "06090030h" in result.refused[0x1005, 0]
    assert "06020000h" in result.refused[0x5FFF, 0]
    assert not result.complete
    assert bench.held()[LIMIT] == number(400, 2)
    assert len(differing({key: factory.values[key] for key in bench.held()}, bench.held())) == 1


def test_what_is_held_already_is_not_written(bench: Bench, factory: ParameterSet, tmp_path: Path) -> None:
    host = bench.host()
    assert loaded(bench, factory, tmp_path / "none", host) == Loaded(len(factory.values))
    assert (host.written, list(tmp_path.iterdir())) == (0, [])
    loaded(bench, changed(factory, {LIMIT: number(400, 2)}), tmp_path, host)
    assert host.written == 1


def test_another_device_is_written_nothing(bench: Bench, factory: ParameterSet, tmp_path: Path) -> None:
    host, wanted = bench.host(), changed(factory, {LIMIT: number(400, 2)})
    vendor, product = factory.device
    for device in ((vendor, frozenset({1})), (frozenset({1}), product), (vendor, frozenset[int]())):
        with pytest.raises(PeerFault, match="is of another device"):
            loaded(bench, replace(wanted, device=device), tmp_path, host)
    assert (host.written, list(tmp_path.iterdir())) == (0, [])


def test_a_drive_that_is_enabled_or_turns_is_written_nothing(
    bench: Bench, factory: ParameterSet, tmp_path: Path
) -> None:
    host, wanted = bench.host(), changed(factory, {LIMIT: number(400, 2)})
    enable(bench)
    with pytest.raises(PeerFault, match=f"is not disabled; statusword .*hil stop --bus .* --node {NODE}"):
        loaded(bench, wanted, tmp_path, host)
    bench.drive.dictionary.download(0x6060, 0, b"\x09")
    bench.drive.dictionary.download(0x60FF, 0, number(20_000))
    host.pump(host.deadline_after(Duration(NS_PER_S // 4)))
    bench.drive.dictionary.download(0x6040, 0, b"\0\0")
    with pytest.raises(PeerFault, match="moves; 6064h went from"):
        loaded(bench, wanted, tmp_path, host)
    assert (host.written, list(tmp_path.iterdir())) == (0, [])
    host.pump(host.deadline_after(Duration(5 * NS_PER_S)))  # it runs out


def test_a_drive_that_is_enabled_meanwhile_is_stopped_and_can_be_put_back(
    bench: Bench, factory: ParameterSet, tmp_path: Path
) -> None:
    wanted = changed(factory, {LIMIT: number(400, 2), (0x6080, 0): number(77), (0x6085, 0): number(5000)})
    calls = 0

    def enabled_at_the_second() -> None:
        nonlocal calls
        calls += 1
        if calls == 2:
            enable(bench)

    request, said = LoadRequest("simulated", RATE, NODE, tmp_path), list[str]()
    with pytest.raises(PeerFault, match="is not disabled"):
        load_parameters(bench.host(), wanted, request, said.append, enabled_at_the_second)
    assert bench.drive.drive.power.state is State.SWITCH_ON_DISABLED
    assert said == [
        f"not all is loaded: the same command goes on with it, hil restore {request.journal} undoes it"
    ]
    assert len(differing(dict(factory.values), {key: bench.held()[key] for key in factory.values})) == 1
    assert bench.undo(tmp_path) == []
    assert differing(dict(factory.values), {key: bench.held()[key] for key in factory.values}) == []


def test_a_journal_of_another_load_waits(bench: Bench, factory: ParameterSet, tmp_path: Path) -> None:
    loaded(bench, changed(factory, {LIMIT: number(400, 2)}), tmp_path)
    with pytest.raises(BadInput, match="a folder without a journal that waits to be put back; hil restore"):
        loaded(bench, changed(factory, {LIMIT: number(300, 2)}), tmp_path)
    assert bench.held()[LIMIT] == number(400, 2)
    assert read_journal(tmp_path / "journal.jsonl").head.loads


def test_what_is_stored_outlives_the_reset(bench: Bench, factory: ParameterSet, tmp_path: Path) -> None:
    result = loaded(bench, changed(factory, {LIMIT: number(400, 2)}), tmp_path, store=True)
    assert (result.stored, result.complete) == (True, True)
    bench.restart()
    assert bench.held()[LIMIT] == number(400, 2)


def test_for_another_node_identifiers_move_and_what_is_its_own_stays() -> None:
    names = {(0x2000, 0): "Node-ID", (0x2001, 0): "CAN bit rate", (0x2002, 0): "gain"}
    names |= dict.fromkeys([(0x1014, 0), (0x1800, 1), (0x1801, 1), (0x1400, 1), (0x1800, 2)], "")
    values = dict.fromkeys(names, number(5))
    values |= {(0x1014, 0): number(0x85), (0x1800, 1): number(0xC0000185), (0x1801, 1): number(0x6A5)}
    values |= {(0x1400, 1): number(0x206)}
    nobody = frozenset[int](), frozenset[int]()
    parameters = ParameterSet("a drive", nobody, values, names, dict.fromkeys(names, 7), {}, node=5)
    moved, left = for_node(parameters, 9)
    assert left.keys() == {(0x2000, 0), (0x2001, 0)}
    assert dict(moved.values) == {
        (0x1014, 0): number(0x89),
        (0x1800, 1): number(0xC0000189),
        (0x1801, 1): number(0x6A5),
        (0x1400, 1): number(0x206),
        (0x1800, 2): number(5),
        (0x2002, 0): number(5),
    }
    assert for_node(parameters, 5) == (parameters, {})
