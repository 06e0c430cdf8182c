"""faults.arrow: entries of every kind come back as they were, and others read them by column."""

import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.wire.frame_port import EXTENDED_FLAG
from servobench.hil.configuration.bench_file import load_faults
from servobench.hil.rows.events import ENTRY_DTYPE
from servobench.hil.rows.faults_file import FaultsWriter, finish_faults, read_entries
from servobench.virtual_bus.faults.fault_log import AT_NODE, KINDS, FaultEntry, entry_line, read_line
from servobench.virtual_bus.faults.fault_table import NONE
from servobench.virtual_bus.faults.register import LOG_KINDS
from tests.unit.virtual_bus.test_fault_log import ENTRIES

DRAWN = 2_000


def drawn(draw: random.Random) -> FaultEntry:
    """One of any kind, with numbers as its kind may tell them."""
    code = draw.randrange(len(LOG_KINDS))
    kind = LOG_KINDS[code]
    numbers = [
        draw.randrange(len(n.words)) if n.words else draw.randint(n.least, 10**12) for n in kind.numbers
    ]
    for place, number in enumerate(kind.numbers):
        if (number.optional or number.usual == NONE) and draw.random() < 0.5:
            numbers[place] = NONE
    if kind.numbers and kind.numbers[0].optional and numbers[0] == NONE:
        numbers[1:] = [0] * (len(numbers) - 1)
    can_id = draw.choice((0x181, 0x1234_5678 | EXTENDED_FLAG)) if kind.tells == "frame" else 0
    n = draw.randrange(2**32) if kind.tells != "nothing" else 0
    links = {"host": [0], "node": [1, 127], "link": [0, 1, AT_NODE * 5, 1 + AT_NODE * 127]}
    a, b, c = (numbers + [0] * 3)[:3]
    at_ns, link = draw.randint(-(10**9), 10**13), draw.choice(links[kind.at])
    return FaultEntry(at_ns, a, b, c, can_id, n, code, link)


@pytest.fixture(scope="module")
def entries() -> list[FaultEntry]:
    draw = random.Random(41)
    return [read_line(line, "f", 1) for line, _ in ENTRIES] + [drawn(draw) for _ in range(DRAWN)]


@pytest.fixture
def path(tmp_path: Path, entries: list[FaultEntry]) -> Path:
    writer = FaultsWriter(path := tmp_path / "faults.arrow")
    packed = np.array(entries, ENTRY_DTYPE)
    for begin in range(0, packed.size, 700):
        writer.write(packed[begin : begin + 700])
    writer.close()
    return path


def test_entries_of_every_kind_strike_again_as_they_were(path: Path, entries: list[FaultEntry]) -> None:
    assert {entry.kind for entry in entries} == set(KINDS)
    found = load_faults(path).entries  # type: ignore[union-attr]
    assert list(found) == entries
    assert list(map(entry_line, found)) == list(map(entry_line, entries))


def test_other_programs_find_each_number_in_a_column_of_its_own(
    path: Path, entries: list[FaultEntry]
) -> None:
    rows = pa.ipc.open_file(path).read_all().to_pylist()
    delays = [
        (entry.a if entry.kind == "delay" else entry.b)
        for entry in entries
        if entry.kind in ("delay", "reorder")
    ]
    told = [row for row in rows if KINDS[row["kind"]] in ("delay", "reorder")]
    assert [row["delay_ns"] for row in told] == delays
    assert all(row["duration_ns"] is None and row["n"] is not None for row in told)
    assert {row["node"] for row in told} == {None, 5, 127}
    assert {row["can_id"] for row in told} == {0x181, 0x12345, 0x1234_5678}, "without flags"


def test_a_cut_file_is_read_to_its_last_whole_batch_and_ended(path: Path, entries: list[FaultEntry]) -> None:
    whole = path.read_bytes()
    for length in range(0, len(whole), len(whole) // 40):
        path.write_bytes(whole[:length])
        count = sum(batch.size for batch in read_entries(path))
        with pytest.raises(BadInput, match="no end of an Arrow file"):
            load_faults(path)
        finish_faults(path)
        assert list(load_faults(path).entries) == entries[:count]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [
        ("kind", len(KINDS), f"column kind: found {len(KINDS)} to {len(KINDS)}, not 0 to {len(KINDS) - 1}"),
        ("direction", 2, "column direction: found 2 to 2, not 0 to 1"),
        ("node", 128, "column node: found 128 to 128, not 1 to 127"),
        ("can_id", 1 << 29, "column can_id: "),
        ("in_order", 2, "column in_order: "),
        ("delay_ns", -7, "column delay_ns: "),
    ],
)
def test_what_no_entry_can_be_is_refused_by_its_column(
    path: Path, column: str, value: int, told: str
) -> None:
    table = pa.ipc.open_file(path).read_all()
    place = table.schema.get_field_index(column)
    values = pa.array([value] * table.num_rows, table.schema.field(place).type)
    with pa.ipc.new_file(str(path), table.schema) as writer:
        writer.write_table(table.set_column(place, table.schema.field(place), values))
    with pytest.raises(BadInput, match="a batch of injected faults") as caught:
        load_faults(path)
    assert told in str(caught.value)
