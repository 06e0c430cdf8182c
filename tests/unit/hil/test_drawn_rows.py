"""What is drawn of rows and of observed frames: every series at its instants, computed apart."""

import struct
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.loop.cycle_record import COMMAND_FATES, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.recording.observed_frames import ObservedFrames
from servobench.hil.recording.row_series import first_offset_ns, lines_of, main_lines_of, marks_of
from servobench.hil.rows.recording_plan import ObservedDrive, ObservedSignal
from servobench.hil.rows.records import LabelChange, LinkStates, Rows
from servobench.hil.rows.side_rows import FRAME_DTYPE, frame_row
from tests.unit.hil.row_tools import plain_rows

RPM: Final = 30.0 / np.pi
MS: Final = NS_PER_MS
NAN: Final = float("nan")


@pytest.fixture
def rows() -> Rows:
    """Four cycles: the second's reading was lost, the third's command too."""
    made = plain_rows(4, reference=[1.0, 2.0, 3.0, 4.0], velocity=[0.5, 9.0, 1.5, 2.0], fate=[0, 1, 0, 0])
    made["estimate_valid_at"] = [NOTHING, 5, 6, 7]
    made["estimate_velocity_rad_s"] = [9.0, 0.25, 0.75, 1.25]
    made["command_torque_nm"], made["load_torque_nm"] = [0.1, 0.2, 0.3, 0.4], [0.0, 0.0, 0.5, 0.5]
    made["torque_nm"] = [0.01, 9.0, 0.03, 0.04]
    made["delay_ns"] = [100_000, NOTHING, 300_000, 0]
    made["certain"] = [1, 0, 0, 1]
    made["command_handed_at"] = made["due_at"] + 10_000
    made["command_on_bus_at"] = [40_000, NOTHING, 2 * MS + 50_000, 3 * MS + 60_000]
    made["command_acts_by"] = [1 * MS, 2 * MS, NOTHING, 4 * MS]
    made["command_fate"][2] = COMMAND_FATES.index(CommandFate.LOST)
    made["compute_ns"] = [5_000, NOTHING, 7_000, 8_000]
    made["clock_offset_ns"] = [NOTHING, 1_000, 3_000, NOTHING]
    made["clock_error_ns"] = 500
    made["reference_position_rad"], made["position_rad"] = [1.0, 1.1, 1.2, 1.3], [0.9, 9.0, 1.15, 1.31]
    made["sampled_at"] = made["due_at"] + 100_000_000
    return made


Drawn = dict[str, tuple[list[int], Any]]


def drawn(series: Any) -> Drawn:
    """Times in ms."""
    return {
        path: ((times // MS).tolist(), pytest.approx(values.tolist(), nan_ok=True))
        for path, times, values in series
    }


MAIN: Final[dict[str, list[float]]] = {
    "speed/reference": [1.0 * RPM, 2.0 * RPM, 3.0 * RPM, 4.0 * RPM],
    "speed/estimate": [NAN, 0.25 * RPM, 0.75 * RPM, 1.25 * RPM],
    "speed/measured": [0.5 * RPM, NAN, 1.5 * RPM, 2.0 * RPM],
    "error/error": [0.5 * RPM, NAN, 1.5 * RPM, 2.0 * RPM],
    "torque/command": [100.0, 200.0, 300.0, 400.0],
    "torque/load": [0.0, 0.0, 500.0, 500.0],
    "torque/measured": [10.0, NAN, 30.0, 40.0],
    "delay/delay": [100.0, NAN, 300.0, 0.0],
}
COMMANDS: Final[dict[str, list[float]]] = {
    "commands/on_bus": [30.0, NAN, 40.0, 50.0],
    "commands/acting": [990.0, 990.0, NAN, 990.0],
    "commands/computing": [5.0, NAN, 7.0, 8.0],
}
CLOCK: Final[dict[str, list[float]]] = {
    "clock/offset": [NAN, 0.0, 2.0, NAN],
    "clock/lower": [NAN, -0.5, 1.5, NAN],
    "clock/upper": [NAN, 0.5, 2.5, NAN],
}
# a sample is 100 ms late, in which the reference goes on at its own speed
POSITIONS: Final[dict[str, list[float]]] = {
    "position/reference": [1.0, 1.1, 1.2, 1.3],
    "position/measured": [0.9, NAN, 1.15, 1.31],
    "position_error/error": [0.2, NAN, 0.35, 0.39],
}


def lines(series: Any) -> dict[str, Any]:
    return {path: pytest.approx(values.tolist(), nan_ok=True) for path, values in series}


def test_lines_are_the_columns_in_the_units_of_their_plots(rows: Rows) -> None:
    nowhere = {path: [NAN] * 4 for path in CLOCK}
    unknown = rows.copy()
    unknown["clock_offset_ns"] = NOTHING
    assert lines(main_lines_of(rows, 1e3)) == MAIN
    assert lines(lines_of(unknown, 1e3, None)) == MAIN | COMMANDS | nowhere
    assert lines(lines_of(rows, 1e3, 1_000)) == MAIN | COMMANDS | CLOCK
    assert lines(lines_of(rows, 1e3, 1_000, positions=True)) == MAIN | POSITIONS | COMMANDS | CLOCK


def test_marks_are_what_was_lost_or_is_in_doubt(rows: Rows) -> None:
    assert drawn(marks_of(rows)) == {
        "speed/dropped": ([1], [0.25 * RPM]),
        "delay/dropped": ([1], [0.0]),
        "delay/uncertain": ([1, 2], [0.0, 300.0]),
        "commands/lost": ([2], [0.0]),
    }


def test_a_clock_s_offset_counts_from_the_first_that_is_known(rows: Rows) -> None:
    assert first_offset_ns(rows) == 1_000
    assert first_offset_ns(rows[:1]) is None
    assert first_offset_ns(rows[:0]) is None


@pytest.mark.parametrize(
    ("dropped", "labels"),
    [
        (0, ["OK"]),
        (1, ["OK", "DEGRADED", "OK"]),
        (19, ["OK", "DEGRADED", "OK"]),
        (20, ["OK", "DEGRADED", "DOWN", "DEGRADED", "OK"]),
    ],
)
def test_any_dropout_degrades_a_link_and_twenty_end_it(dropped: int, labels: list[str]) -> None:
    found = LinkStates().changes(plain_rows(1080, fate=[0] * 5 + [2] * dropped + [0] * (1075 - dropped)))
    assert [change.label for change in found] == labels
    assert found[0] == LabelChange(0, "OK")


# ---- observed objects ---------------------------------------------------------------------------------


def frame(can_id: int, data: bytes, at: int = 0, sent: int = 0) -> bytes:
    return frame_row(Instant(at), can_id, sent, data)


def mapped(number: int, sub: int, index: int, index_sub: int, bits: int, node: int = 3) -> bytes:
    """A drive's answer that tells an entry of a TPDO's mapping."""
    entry = struct.pack("<BHBI", 0x43, 0x1A00 + number - 1, sub, index << 16 | index_sub << 8 | bits)
    return frame(0x580 + node, entry)


def frames(*rows: bytes) -> NDArray[np.void]:
    return np.frombuffer(b"".join(rows), FRAME_DTYPE)


TEMPERATURE: Final = ObservedSignal((0x2030, 1), "h", "temperature", "degC", 0.1)
VOLTAGE: Final = ObservedSignal((0x6079, 0), "I", "DC link", "V", 1e-3)


def observed(*taken: NDArray[np.void], segment: int = 0) -> Drawn:
    """By path, instants and values."""
    told = ObservedFrames({"axis1": ObservedDrive(3, segment, (TEMPERATURE, VOLTAGE))})
    for each in taken:
        told.take(each)
    found = {path: (times.tolist(), values.tolist()) for path, times, values in told.drain()}
    assert list(told.drain()) == [], "what was told is told once"
    return found


MAPPING: Final = (mapped(4, 1, 0x6041, 0, 16), mapped(4, 2, 0x2030, 1, 16), mapped(4, 3, 0x6079, 0, 32))
"""Of TPDO4, 483h: a statusword, the temperature, the voltage."""


def pdo(temperature: int, voltage: int, at: int, sent: int = 0) -> bytes:
    return frame(0x483, struct.pack("<HhI", 0x627, temperature, voltage), at, sent)


def test_signals_are_read_where_the_mapping_has_them() -> None:
    found = observed(frames(*MAPPING), frames(pdo(-250, 48_000, 5), pdo(251, 3_000_000_000, 6)))
    assert found == {
        "/axis1/observed/2030h_1": ([5, 6], pytest.approx([-25.0, 25.1])),
        "/axis1/observed/6079h_0": ([5, 6], pytest.approx([48.0, 3_000_000.0])),
    }


def test_blocks_are_joined_and_a_mapping_holds_from_the_frames_that_come_with_it() -> None:
    found = observed(
        frames(pdo(1, 1, 1)),
        frames(*MAPPING, pdo(10, 1000, 2)),
        frames(),
        frames(frame(0x183, b"\0" * 8, 3)),
        frames(pdo(20, 2000, 4)),
    )
    assert found["/axis1/observed/2030h_1"] == ([2, 4], pytest.approx([1.0, 2.0]))


def test_no_line_crosses_a_gap_where_frames_did_not_come() -> None:
    told = ObservedFrames({"axis1": ObservedDrive(3, 0, (TEMPERATURE,), every_ns=100)})
    told.take(frames(*MAPPING, pdo(10, 1, 1000), pdo(10, 1, 1149), pdo(20, 1, 1300)))
    told.take(frames(pdo(30, 1, 1900)))
    ((_, times, values),) = told.drain()
    assert times.tolist() == [1000, 1149, 1200, 1300, 1800, 1900]
    assert values.tolist() == pytest.approx([1.0, 1.0, np.nan, 2.0, np.nan, 3.0], nan_ok=True)


def test_a_frame_that_is_too_short_for_a_signal_tells_the_others() -> None:
    found = observed(frames(*MAPPING, frame(0x483, struct.pack("<Hhh", 0x627, 30, 0), 7)))
    assert found["/axis1/observed/2030h_1"] == ([7], pytest.approx([3.0]))
    assert found["/axis1/observed/6079h_0"] == ([], [])


def test_frames_of_other_segments_and_nodes_tell_nothing() -> None:
    second = [frame(0x583, row[16:24], 0, 2) for row in MAPPING]
    assert observed(frames(*MAPPING, pdo(1, 1, 1)), segment=1) == {}
    found = observed(frames(*second, pdo(10, 1, 1, sent=2), pdo(20, 1, 2)), segment=1)
    assert found["/axis1/observed/2030h_1"] == ([1], pytest.approx([1.0]))
    assert observed(frames(mapped(4, 1, 0x2030, 1, 16, node=4), pdo(1, 1, 1))) == {}


@pytest.mark.parametrize(
    "answer",
    [
        struct.pack("<BHBI", 0x4B, 0x1A03, 1, 0x20300110),
        struct.pack("<BHBI", 0x43, 0x1A03, 0, 0x20300110),
        struct.pack("<BHBI", 0x43, 0x19FF, 1, 0x20300110),
        struct.pack("<BHBI", 0x43, 0x6041, 1, 0x20300110),
    ],
)
def test_other_answers_are_no_mapping(answer: bytes) -> None:
    assert observed(frames(frame(0x583, answer), frame(0x483, b"\1\0", 1))) == {}
