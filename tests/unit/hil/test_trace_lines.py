"""A recording traced by columns: letter by letter what its frames say one by one."""

import json
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.hil.reviewing.trace import pdo_book
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.frame_columns import FrameColumns
from servobench.hil.reviewing.trace.node_objects import KnownNodes, SheetFile
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.reviewing.trace.trace_entry import TraceEntry, TraceSelection
from servobench.hil.reviewing.trace.trace_lines import TraceLines
from servobench.hil.terminal.trace import line_of
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.virtual_bus.device.communication_objects import export_eds
from tests.draws import examples_of, few_of
from tests.recorded_frames import write_frames
from tests.scenario.processes import EXAMPLES
from tests.scenario.test_canopen_master import make_device

SELECTIONS = [
    TraceSelection(),
    TraceSelection(node=2),
    TraceSelection(kinds=frozenset({"sync", "pdo"})),
    TraceSelection(kinds=frozenset({"sdo", "heartbeat"})),
    TraceSelection(from_s=0.05),
    TraceSelection(node=1, kinds=frozenset({"pdo"}), from_s=0.05, to_s=0.2),
]
CASES = [
    *((selection, bool(number % 2)) for number, selection in enumerate(SELECTIONS)),
    *((selection, not number % 2) for number, selection in enumerate(SELECTIONS)),
]
"""Each selection as text or as JSON, the first as both, then the other way round."""
FACTORS = ((0x6076, 0, 1270), (0x608F, 1, 65536), (0x608F, 2, 1), (0x6075, 0, 2300))
MAPPABLE = (
    *(0x6064_0020, 0x606C_0020, 0x6077_0010, 0x6041_0010),
    *(0x6061_0008, 0x1013_0020, 0x6078_0010, 0x0005_0008),
)
OTHERS = (
    *("{0}#05", "{0}#R", "{1}#R", "{2}#1023040000000000", "000#0100", "12345678#AABB"),
    *("7E5#0401000000000000", "20000004#0008000000000000", "100#0011", "6C1#AA", "100#R"),
)
INSTANTS = st.integers(-(10**15), 10**15) | st.integers(-(10**6), 10**6).map(lambda n: 500 * n)
FLOATS = st.floats() | st.floats(-1e7, 1e7) | st.integers(-(10**8), 10**8).map(lambda n: n / 2)


@examples_of(100)
@given(st.lists(INSTANTS, min_size=1))
def test_times_are_rounded_as_python_rounds_them(ns: list[int]) -> None:
    told = pdo_book.micro_seconds(np.array(ns, np.int64)).to_pylist()
    assert told == [f"{each / 1e9:.6f}" for each in ns]


@examples_of(100)
@given(st.lists(FLOATS, min_size=1))
def test_numbers_are_those_of_python(values: list[float]) -> None:
    column = np.array(values)
    assert pdo_book.general(column).to_pylist() == [f"{each:.6g}" for each in values]
    assert pdo_book.shortest(column).to_pylist() == [repr(each) for each in values]


def one_by_one(decoded: list[TraceEntry], selection: TraceSelection, zero_ns: int, as_json: bool) -> str:
    entries = selection.of(iter(decoded), zero_ns)
    return "".join(f"{line}\n" for line in worded(entries, zero_ns, as_json))


def worded(entries: Iterator[TraceEntry], zero_ns: int, as_json: bool) -> Iterator[str]:
    for entry in entries:
        yield json.dumps(entry.as_json(zero_ns)) if as_json else line_of(entry, zero_ns)


def by_columns(
    log: FrameColumns, known: KnownNodes, selection: TraceSelection, zero_ns: int, as_json: bool
) -> str:
    def told(entry: TraceEntry) -> str:
        return next(worded(iter((entry,)), zero_ns, as_json))

    return "".join(TraceLines(known, selection, zero_ns, told, as_json).of(log))


def drawn_log(dice: random.Random, count: int) -> str:
    """SYNCs with and without counter, PDOs of all lengths, mappings and factors told meanwhile, nodes that
    turn up late, whatever else there is."""
    lines: list[str] = []
    at_us = 1_000_000_000_000_000

    def say(text: str, channel: str = "can0") -> None:
        nonlocal at_us
        at_us += dice.choice((1, 7, 113, 250))
        lines.append(f"({at_us // 10**6}.{at_us % 10**6:06d}) {channel} {text}")

    def write(node: int, index: int, sub: int, value: int, size: int = 4) -> None:
        head, code = f"{index & 0xFF:02X}{index >> 8:02X}{sub:02X}", 0x23 if size == 4 else 0x2F
        say(f"{0x600 + node:03X}#{code:02X}{head}{value.to_bytes(4, 'little').hex().upper()}")
        say(f"{0x580 + node:03X}#60{head}00000000")

    nodes = [1, 2, 77]
    for number in range(count):
        draw = dice.random()
        node = dice.choice(nodes[: 1 + 3 * number // count])
        if number % 400 == 30:
            words = dice.sample(MAPPABLE, dice.randrange(1, 4))
            base = dice.choice((0x1A00, 0x1A01, 0x1600))
            for sub, word in enumerate(words, start=1):
                write(node, base, sub, word)
            write(node, base, 0, len(words), size=1)
        elif number % 400 == 200:
            index, sub, value = dice.choice(FACTORS)
            write(node, index, sub, value)
        elif draw < 0.2:
            say(dice.choice(("080#", f"080#{number % 240:02X}", "080#0102")))
        elif draw < 0.9:
            can_id = dice.choice((0x180, 0x280, 0x200, 0x480)) + node
            data = dice.choice((b"", b"\x37\x06", dice.randbytes(8), number.to_bytes(4, "little") * 2))
            channel = dice.choice(("can0", "can0", "bus\u00fc"))
            say(f"{can_id:03X}#{data[: dice.randrange(9)].hex().upper()}", channel)
        else:
            say(dice.choice(OTHERS).format(*(f"{base + node:03X}" for base in (0x700, 0x180, 0x080))))
    return "".join(f"{line}\n" for line in lines)


@pytest.mark.long
@pytest.mark.parametrize("seed", few_of(range(8), 1))
def test_drawn_buses(tmp_path: Path, seed: int) -> None:
    write_frames(tmp_path, drawn_log(random.Random(seed), 3000))
    log = FrameColumns(tmp_path)
    zero_ns = (next(iter(log)).at_ns or 0) + 40_000_500
    sheet = tmp_path / "device.eds"
    sheet.write_text(export_eds(make_device().dictionary), encoding="latin-1")
    for sheets in ([], [SheetFile(sheet, 2)]):
        decoded = list(decode(iter(log), KnownNodes(sheets)))
        for selection, as_json in few_of(CASES, 7):
            expected = one_by_one(decoded, selection, zero_ns, as_json)
            assert by_columns(log, KnownNodes(sheets), selection, zero_ns, as_json) == expected


@pytest.mark.long
@pytest.mark.parametrize("example", few_of(["two_segments.toml", "ling2012.toml"], 1))
def test_a_run(servo_bench: BenchRunner, example: str) -> None:
    run = RecordedBus(servo_bench(EXAMPLES / example).folder)
    assert isinstance(run.log, FrameColumns)
    decoded = list(decode(iter(run.log), run.known([])))
    for selection, as_json in few_of(CASES, 7):
        arguments = (selection, run.zero_ns or 0, as_json)
        expected = one_by_one(decoded, *arguments)
        assert by_columns(run.log, run.known([]), *arguments) == expected
        assert len(expected) > 10_000 or selection.node == 2
