"""Writer for a loop's rows of cycles and of raw frames, each into its ring."""

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FrameTap
from servobench.drivers.wire.identifiers import EXTENDED_FLAG, REMOTE_FLAG
from servobench.hil.loop.samples import CycleRecord
from servobench.hil.recording.ring import RingWriter
from servobench.hil.rows.records import row_of


class RowWriter(FrameTap):
    """The cyclic part of a recorder."""

    def __init__(self, rows: RingWriter, frames: RingWriter, keep_frames: bool, segment: int = 0) -> None:
        """``rows`` of :data:`~servobench.hil.rows.records.ROW`, ``frames`` of FRAME; ``segment``: its
        number."""
        self._received = 2 * segment
        self._sent = 2 * segment + 1
        self._push = rows.push
        self._push_frame = frames.push_frame
        self._keep_frames = keep_frames

    def record(self, record: CycleRecord) -> None:
        """Store one cycle."""
        self._push(row_of(record))

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Store one raw frame, if frames are kept."""
        if not self._keep_frames:
            return
        if extended:
            can_id |= EXTENDED_FLAG
        if remote:
            can_id |= REMOTE_FLAG
        self._push_frame(at, can_id, self._sent if direction == "tx" else self._received, data)
