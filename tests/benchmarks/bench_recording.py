"""What recording costs the loop: one cycle record, one frame; beside packing the same bytes alone.

Each figure is the CPU cost of one call, from batches, so that the clock's own cost does not count.
"""

import struct
from collections.abc import Callable

import numpy as np

from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_US, Duration, Instant, MonotonicClock
from servobench.hil.loop.cycle_record import ROW, CycleRecord, row_of
from servobench.hil.loop.samples import CommandFate, Sample, Sending, StateEstimate
from servobench.hil.recording.ring import RingReader, RingWriter
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.side_rows import FRAME, FRAME_DTYPE, frame_row
from tests.unit.hil.row_tools import cycle_record

_BATCH, _BATCHES = 1_000, 200
_CAPACITY = 1 << 10


def main() -> None:
    """Print a table."""
    record = _record()
    fields = ROW.unpack(row_of(record))
    rows, row_reader = _ring(ROW, ROW_DTYPE)
    frames, frame_reader = _ring(FRAME, FRAME_DTYPE)
    buffer = bytearray(ROW.size)
    cases: list[tuple[str, Callable[[], object], RingReader]] = [
        ("pack a cycle record (baseline)", lambda: ROW.pack_into(buffer, 0, *fields), row_reader),
        ("record a cycle", lambda: rows.push(row_of(record)), row_reader),
        (
            "pack a frame (baseline)",
            lambda: FRAME.pack_into(buffer, 0, 1, 2, 8, 1, b"12345678"),
            frame_reader,
        ),
        ("record a frame", lambda: frames.push(frame_row(Instant(1), 2, 1, b"12345678")), frame_reader),
    ]
    print(f"{'':32} {'p50':>8} {'p99':>8} {'max':>8} us   x baseline")
    baseline = 1.0
    for title, call, reader in cases:
        costs = _costs_us(call, reader)
        p50, p99, largest = np.quantile(costs, 0.5), np.quantile(costs, 0.99), max(costs)
        baseline = p50 if "baseline" in title else baseline
        print(f"{title:32} {p50:8.2f} {p99:8.2f} {largest:8.2f}      {p50 / baseline:6.1f}")


def _record() -> CycleRecord:
    at = Instant(1_000_000)
    return cycle_record(
        sequence=1,
        axis=0,
        due_at=at,
        woke_at=at,
        sync_handed_at=at,
        sync_on_bus_at=at,
        observation=Sample(1, Reading(2.0, 1_000, at, 1.0, at, 3.0, at, 0x1637, at), at, 5_000, True),
        delay=Duration(500_000),
        estimate=StateEstimate(1.0, 2.0, 3.0, at, 1),
        reference_rad_s=157.0,
        load_torque_nm=0.6,
        command=Command(1, 0.6, at, at),
        sending=Sending(600, at, at, CommandFate.ACTING, at, at),
        clock_offset_ns=Duration(123_456),
        clock_error_ns=Duration(1_200),
    )


def _ring(row: struct.Struct, dtype: np.dtype[np.void]) -> tuple[RingWriter, RingReader]:
    writer = RingWriter(row, _CAPACITY)
    return writer, RingReader(writer.descriptor, dtype)


def _costs_us(call: Callable[[], object], reader: RingReader) -> list[float]:
    """Mean cost of a call in each batch; the ring is emptied between the batches."""
    clock = MonotonicClock()
    found = []
    for _ in range(_BATCHES):
        reader.drain()
        start = clock.now()
        for _ in range(_BATCH):
            call()
        found.append((clock.now() - start) / _BATCH / NS_PER_US)
    return found


if __name__ == "__main__":
    main()
