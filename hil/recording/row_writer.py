"""Writer for a loop's rows of cycles and of raw frames, each into its ring."""

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FrameTap, WireFrame
from servobench.hil.core.native import FrameSink
from servobench.hil.loop.cycle_record import CycleRecord, row_of
from servobench.hil.recording.ring import RingWriter


class RowWriter(FrameTap):
    """The cyclic part of a recorder."""

    def __init__(self, rows: RingWriter, frames: RingWriter, keep_frames: bool, segment: int = 0) -> None:
        """``rows`` of :data:`~servobench.hil.loop.cycle_record.ROW`, ``frames`` of FRAME; ``segment``: its
        number."""
        self._push = rows.push
        self._sink = FrameSink(frames if keep_frames else None, segment)
        self.native = self._sink

    def record(self, record: CycleRecord) -> None:
        """Store one cycle."""
        self._push(row_of(record))

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Store one raw frame, if frames are kept."""
        self._sink.show(WireFrame(can_id, data, extended, remote), direction == "tx", at)
