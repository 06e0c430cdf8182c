"""Raw frames as the loop writes them into their ring."""

from collections.abc import Iterator

import pytest

from servobench.drivers.timebase import Instant
from servobench.hil.recording.ring import RingReader, RingWriter
from servobench.hil.recording.row_writer import RowWriter
from servobench.hil.rows.side_rows import FRAME, FRAME_DTYPE


@pytest.fixture
def ring() -> Iterator[RingWriter]:
    writer = RingWriter(FRAME, 8)
    yield writer
    writer.close()


@pytest.mark.parametrize("segment", [0, 1, 5])
def test_a_frame_is_kept_with_its_flags_its_direction_and_its_segment(ring: RingWriter, segment: int) -> None:
    """struct can_frame: bit 31 is an identifier of 29 bits, bit 30 a remote frame."""
    writer = RowWriter(ring, ring, keep_frames=True, segment=segment)
    at = Instant(12_345_678_901)
    writer.frame("rx", 0x181, b"\x01\x02", False, False, at)
    writer.frame("tx", 0x701, b"", False, True, at)
    writer.frame("rx", 0x12345678, b"12345678", True, False, at)
    writer.frame("tx", 0x12345678, b"", True, True, at)
    rows = RingReader(ring.descriptor, FRAME_DTYPE).drain()
    assert rows["at"].tolist() == [at] * 4
    assert rows["can_id"].tolist() == [0x181, 0x4000_0701, 0x9234_5678, 0xD234_5678]
    assert rows["length"].tolist() == [2, 0, 8, 0]
    assert rows["sent"].tolist() == [2 * segment + sent for sent in (0, 1, 0, 1)]
    assert rows["data"][0].tolist() == [1, 2, 0, 0, 0, 0, 0, 0]


def test_frames_are_kept_only_where_they_are_asked_for(ring: RingWriter) -> None:
    RowWriter(ring, ring, keep_frames=False).frame("rx", 0x181, b"", False, False, Instant(0))
    assert RingReader(ring.descriptor, FRAME_DTYPE).drain().size == 0
