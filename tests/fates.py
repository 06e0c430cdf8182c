"""What tests of faults share: keys of their tables, and the fate of a frame in words."""

from typing import Any, NamedTuple

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.bus.judge import LOST, Direction, Judge


class FrameFate(NamedTuple):
    """What becomes of a frame."""

    dropped: bool
    """It does not go on as it is; ``replacements`` says what does, if anything."""
    delay_ns: Duration
    """Until it goes on; 0 if dropped."""


PASSED = FrameFate(False, Duration(0))
DROPPED = FrameFate(True, Duration(0))


def fate_of(
    judge: Judge, direction: Direction, can_id: int, now: Instant, extended: bool = False
) -> FrameFate:
    """What ``judge`` makes of a frame that is there at ``now``."""
    held = judge.hold(int(direction), can_id, now, extended)
    return DROPPED if held == LOST else FrameFate(False, Duration(held))


def keys(**given: Any) -> dict[str, Any]:
    """``given``, for ``**``."""
    return given
