"""Who decides about the frames of one participant, in front of its inbox and its sending."""

from collections.abc import Sequence
from enum import IntEnum
from typing import Final

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.frame import Frame

LOST: Final = -1
"""The frame does not go on as it is."""


class Direction(IntEnum):
    """Which way a frame travels, whoever looks at it."""

    HOST_TO_DRIVE = 0
    DRIVE_TO_HOST = 1

    @property
    def label(self) -> str:
        """Name in a plan: ``host_to_drive``."""
        return self.name.lower()


class Judge:
    """Passes, loses or holds each frame."""

    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:
        """For how long a frame is held that is there at ``now``, ns; LOST if it does not go on as it is.

        ``way``: the number of its Direction, in which ``now`` may not run backwards.
        """
        raise NotImplementedError

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """Return the replacements of ``frame``, which ``hold`` has just lost: copies or damaged ones, each
        with its delay; empty if it is lost."""
        raise NotImplementedError

    def goes_on(self, way: int, frame: Frame, now: Instant) -> Sequence[tuple[Frame, Duration]]:
        """Return the results of ``frame``, which is present at ``now``, each with its delay; empty if it is
        lost."""
        held = self.hold(way, frame.can_id, now, frame.extended)
        return self.replacements(frame) if held == LOST else [(frame, Duration(held))]
