"""The journal of a commissioning: on the disk before the change, and readable after any end."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.errors import BadInput
from servobench.hil.restoring.journal import (
    DriveMark,
    Journal,
    JournalHead,
    ObjectKey,
    ObjectWrite,
    append_restored,
    read_journal,
)
from tests.draws import examples_of

HEAD = JournalHead("hub:bench", 7, DriveMark(1, 2, 3), 127, 0)
LIMIT = ObjectKey(0x6072, 0)
HEARTBEAT = ObjectKey(0x1016, 1)
PDOS = (0x1400, 0x15FF, 0x1602, 0x1800, 0x1BFF)


def changes() -> st.SearchStrategy[list[ObjectWrite]]:
    key = st.builds(ObjectKey, st.sampled_from(PDOS), st.sampled_from((1, 2, 3, 5)))
    octets = st.binary(max_size=8)
    return st.lists(st.builds(ObjectWrite, key, octets, octets), max_size=8)


def written(path: Path, noted: list[ObjectWrite]) -> Journal:
    path.unlink(missing_ok=True)
    journal = Journal(path, HEAD)
    for change in noted:
        journal.note(change)
    return journal


def test_what_is_noted_is_on_the_disk_at_once(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "new" / "journal.jsonl", HEAD)
    journal.note(ObjectWrite(LIMIT, b"\xb8\x0b", b"\xf4\x01"))
    lines = journal.path.read_text().splitlines()
    assert json.loads(lines[0])["node"] == 7
    assert json.loads(lines[1]) == {"object": "6072:00", "old": "b80b", "new": "f401"}
    journal.close()


@examples_of(40)
@given(noted=changes())
def test_reading_gives_back_what_was_noted(
    tmp_path_factory: pytest.TempPathFactory, noted: list[ObjectWrite]
) -> None:
    path = tmp_path_factory.getbasetemp() / "round.jsonl"
    written(path, noted).close()
    contents = read_journal(path)
    assert contents.head == HEAD
    assert contents.changes == noted
    assert not contents.restored


@examples_of(40)
@given(noted=changes(), torn=st.integers(0, 10_000))
def test_a_torn_end_loses_only_what_was_never_made(
    tmp_path_factory: pytest.TempPathFactory, noted: list[ObjectWrite], torn: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "torn.jsonl"
    written(path, noted).close()
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    kept = head + torn % (len(data) - head + 1)
    path.write_bytes(data[:kept])
    whole = data[:kept].count(b"\n") - 1
    assert read_journal(path).changes == noted[:whole]


def test_the_first_old_value_is_the_one_to_put_back(tmp_path: Path) -> None:
    journal = written(
        tmp_path / "j.jsonl",
        [
            ObjectWrite(LIMIT, b"\x01", b"\x02"),
            ObjectWrite(HEARTBEAT, b"\x09", b"\x08"),
            ObjectWrite(LIMIT, b"\x02", b"\x03"),
        ],
    )
    journal.close()
    originals = read_journal(journal.path).originals()
    assert originals == {LIMIT: b"\x01", HEARTBEAT: b"\x09"}
    assert list(originals) == [LIMIT, HEARTBEAT], "in the order of the first changes"


def test_a_journal_that_waits_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    written(path, [ObjectWrite(LIMIT, b"\x01", b"\x02")]).close()
    before = path.read_bytes()
    with pytest.raises(BadInput, match=rf"hil restore {path}"):
        Journal(path, HEAD)
    assert path.read_bytes() == before
    append_restored(path)
    assert read_journal(path).restored
    Journal(path, HEAD).close()
    assert read_journal(path).changes == []


def test_a_change_after_the_restoration_waits_again(tmp_path: Path) -> None:
    journal = written(tmp_path / "j.jsonl", [ObjectWrite(LIMIT, b"\x01", b"\x02")])
    journal.note_restored()
    assert read_journal(journal.path).restored
    journal.note(ObjectWrite(LIMIT, b"\x01", b"\x02"))
    journal.close()
    assert not read_journal(journal.path).restored


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no json\n",
        "[1]\n",
        '{"journal": 2, "bus": "x", "node": 1, "vendor": 0, "product": 0, "serial": 0, "nmt": null}\n',
        '{"object": "6072:00", "old": "00", "new": "01"}\n',
        '{"journal": 1, "bus": "x"}\n',
    ],
)
def test_what_is_no_journal_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"j\.jsonl"):
        read_journal(path)


def test_a_spoilt_line_in_the_middle_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    written(path, [ObjectWrite(LIMIT, b"\x01", b"\x02"), ObjectWrite(HEARTBEAT, b"\x01", b"\x02")]).close()
    path.write_text(path.read_text().replace('"6072:00"', '"sixty"'))
    with pytest.raises(BadInput, match="line 2"):
        read_journal(path)


def test_no_file_and_no_place(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="Journal not found"):
        read_journal(tmp_path / "absent.jsonl")
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="a place for the journal"):
        Journal(tmp_path / "file" / "journal.jsonl", HEAD)
