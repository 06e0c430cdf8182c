"""The shared-memory ring: order, room, refusal, back-pressure, and a writer that is killed."""

import multiprocessing
import os
import signal
import struct
from collections.abc import Iterator
from multiprocessing.process import BaseProcess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.hil.recording.ring import RingReader, RingWriter
from tests.draws import examples_of

ROW = struct.Struct("<qQ8s")
DTYPE = np.dtype([("number", "<i8"), ("copy", "<u8"), ("text", "S8")])


@pytest.fixture
def ring() -> Iterator[tuple[RingWriter, RingReader]]:
    writer = RingWriter(ROW, 8)
    yield writer, RingReader(writer.descriptor, DTYPE)
    writer.close()


def push(writer: RingWriter, number: int) -> bool:
    return writer.push(ROW.pack(number, number, b"row"))


def test_rows_come_out_as_they_went_in(ring: tuple[RingWriter, RingReader]) -> None:
    writer, reader = ring
    assert reader.drain().size == 0
    writer.push(ROW.pack(-5, 7, b"abc"))
    (row,) = reader.drain()
    assert (int(row["number"]), int(row["copy"]), bytes(row["text"])) == (-5, 7, b"abc")
    assert reader.drain().size == 0


def test_a_full_ring_refuses_and_counts_and_keeps_what_it_has(ring: tuple[RingWriter, RingReader]) -> None:
    writer, reader = ring
    assert [push(writer, number) for number in range(11)] == [True] * 8 + [False] * 3
    assert writer.refused == reader.refused == 3
    assert reader.drain()["number"].tolist() == list(range(8))
    assert push(writer, 11)
    assert reader.drain()["number"].tolist() == [11]


def test_drained_rows_are_a_copy(ring: tuple[RingWriter, RingReader]) -> None:
    writer, reader = ring
    push(writer, 1)
    rows = reader.drain()
    for number in range(2, 12):
        push(writer, number)
    assert rows["number"].tolist() == [1]


@examples_of(100)
@given(st.lists(st.integers(0, 12), max_size=40))
def test_any_pattern_of_pushes_and_drains_keeps_order(bursts: list[int]) -> None:
    writer = RingWriter(ROW, 8)
    reader = RingReader(writer.descriptor, DTYPE)
    sent = accepted = 0
    expected: list[int] = []
    found: list[int] = []
    for burst in bursts:
        for place in range(burst):
            stored = push(writer, sent)
            assert stored == (place < 8)
            if stored:
                expected.append(sent)
                accepted += 1
            sent += 1
        found += reader.drain()["number"].tolist()
    assert found == expected
    assert writer.refused == sent - accepted
    writer.close()


def test_back_pressure_waits_for_the_reader() -> None:
    waits = 0

    def drain_at_third_wait() -> bool:
        nonlocal waits
        waits += 1
        if waits == 3:
            found.extend(reader.drain()["number"].tolist())
        return True

    found: list[int] = []
    writer = RingWriter(ROW, 4, drain_at_third_wait)
    reader = RingReader(writer.descriptor, DTYPE)
    assert all(push(writer, number) for number in range(5))
    assert waits == 3
    assert found + reader.drain()["number"].tolist() == [0, 1, 2, 3, 4]
    assert writer.refused == 0
    writer.close()


@pytest.mark.parametrize("capacity", [0, -4, 3, 100])
def test_capacity_is_a_power_of_two(capacity: int) -> None:
    with pytest.raises(ValueError, match="power of two"):
        RingWriter(ROW, capacity)


def test_reader_rejects_rows_of_another_size(ring: tuple[RingWriter, RingReader]) -> None:
    with pytest.raises(ValueError, match="24 bytes, expected 8"):
        RingReader(ring[0].descriptor, np.dtype([("number", "<i8")]))


def _count_up(writer: RingWriter, limit: int) -> None:
    for number in range(limit):
        push(writer, number)


def _forked(writer: RingWriter, limit: int) -> BaseProcess:
    process = multiprocessing.get_context("fork").Process(target=_count_up, args=(writer, limit))
    process.start()
    return process


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_two_processes_never_see_half_a_row() -> None:
    limit = 50_000
    writer = RingWriter(ROW, 64, on_full=lambda: True)
    reader = RingReader(writer.descriptor, DTYPE)
    process = _forked(writer, limit)
    seen = 0
    while seen < limit:
        rows = reader.drain()
        assert rows["number"].tolist() == list(range(seen, seen + rows.size))
        assert (rows["copy"] == rows["number"].astype(np.uint64)).all()
        seen += rows.size
    process.join()
    writer.close()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_what_a_killed_writer_stored_is_still_there() -> None:
    writer = RingWriter(ROW, 1 << 12)
    reader = RingReader(writer.descriptor, DTYPE)
    process = _forked(writer, 10**12)
    found = 0
    while found < 1_000:
        found += reader.drain().size
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL
    rows = reader.drain()
    assert (np.diff(rows["number"]) > 0).all()
    assert (rows["copy"] == rows["number"].astype(np.uint64)).all()
    assert reader.drain().size == 0
    writer.close()
