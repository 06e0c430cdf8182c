"""Frames in the order of their instants.

The ring holds them in the order of the host's actions: sent frames have the instant of sending, received ones
that of the bus. A host that was held up, by its own waiting or by a stop of its process, sends first and then
fetches the backlog:

    pushed      sent 5.000   received 2.001   received 2.002 ...    on one segment, seconds
    written                  received 2.001   received 2.002 ...   sent 5.000

What was received on a segment comes in its order, up to the jitter of its stamps. So a frame may be written
as soon as every segment has brought one that is later, or brings nothing any more.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS
from servobench.drivers.wire.identifiers import ERROR_FLAG
from servobench.hil.rows.side_rows import FRAME_DTYPE

JITTER_NS: Final = 20 * NS_PER_MS
"""How much older a stamp may be than the previous one on its segment: twice a frame at 10 kbit/s, whose end
an adapter may stamp ahead, and the drift of a wall clock being set between two looks at it."""
SILENCE_NS: Final = 200 * NS_PER_MS
"""A segment that brought nothing since the last look is not waited for, once others went on for so long: as
much as a recording may lack that is cut off."""
_EARLIEST: Final = -(2**62)
"""Before every instant, and the time between it and one that a clock shows still has 64 bits."""


class FrameOrder:
    """Holds frames back until no earlier one can come."""

    def __init__(self, segments: int) -> None:
        """``segments``: how many there are."""
        self.late = 0
        """Frames that came after a later one had been written."""
        self._held: NDArray[np.void] = np.empty(0, FRAME_DTYPE)
        self._received_until = [_EARLIEST] * segments
        self._newest = self._let_go_until = _EARLIEST

    def take(self, frames: NDArray[np.void]) -> NDArray[np.void]:
        """Return the frames that may be written now, in order; frames of one instant as they came.

        ``frames``: (n,) of FRAME_DTYPE, what came since the last call.
        """
        if not frames.size:
            return frames
        self.late += int(np.count_nonzero(frames["at"] < self._let_go_until))
        self._newest = max(self._newest, int(frames["at"].max()))
        limit = min(self._limit(segment, frames) for segment in range(len(self._received_until)))
        held = np.concatenate((self._held, frames))
        held = held[np.argsort(held["at"], kind="stable")]
        count = int(np.searchsorted(held["at"], limit, side="right"))
        ready, self._held = held[:count], held[count:].copy()
        if count:
            self._let_go_until = max(self._let_go_until, int(ready["at"][-1]))
        return ready

    @property
    def held(self) -> NDArray[np.void]:
        """Frames that may not be written yet, in order."""
        return self._held

    def rest(self) -> NDArray[np.void]:
        """Return all held frames, in order: nothing more comes."""
        rest, self._held = self._held, self._held[:0]
        return rest

    def _limit(self, segment: int, frames: NDArray[np.void]) -> int:
        """Return the instant until which a segment can bring no further frame, ns."""
        # Simulated error frames are told at their instant, past what waits to be received.
        received = frames[(frames["sent"] == 2 * segment) & (frames["can_id"] & ERROR_FLAG == 0)]
        if received.size:
            self._received_until[segment] = max(self._received_until[segment], int(received["at"].max()))
            return self._received_until[segment] - JITTER_NS
        return max(self._received_until[segment] - JITTER_NS, self._newest - SILENCE_NS)
