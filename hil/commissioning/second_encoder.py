"""A second encoder, 60E4h:1, beside the first: its direction and its path (CiA 402-2)."""

from collections.abc import Callable
from typing import Final

from servobench.drivers.cia402.objects402 import Object
from servobench.hil.commissioning.findings import StepOutcome
from servobench.hil.commissioning.session import Session

_ALIKE: Final = 0.03
"""Share of the path: a twist or a play is less over a quarter of a turn, another unit or a gear is more."""
_HALF, _WRAP = 1 << 31, 1 << 32


def has_second_encoder(session: Session) -> bool:
    """Return True if 60E4h:1 was among all parameters."""
    return (Object.ADDITIONAL_POSITION, 1) in session.found.dump


def compare_encoders(session: Session, outcome: StepOutcome, turn: Callable[[float], object]) -> None:
    """Turn each way by ``turn``, from rest to rest, and compare the paths that both encoders tell."""
    firsts, seconds = [], []
    for way in (1.0, -1.0):
        before = _both(session)
        turn(way)
        first, second = (_moved(one, other) for one, other in zip(before, _both(session), strict=True))
        firsts.append(first)
        seconds.append(second)
    ratio = (seconds[0] - seconds[1]) / (firsts[0] - firsts[1])
    outcome.figures["second_over_first_encoder"] = ratio
    outcome.say(
        f"second encoder 60E4h:1: {ratio:.4g} of the path of 6064h "
        f"({seconds[0]:+d} of {firsts[0]:+d} units forwards, {seconds[1]:+d} of {firsts[1]:+d} backwards)"
    )
    if ratio < 0.0:
        outcome.faults.append("second encoder: 60E4h:1 counts against 6064h; turn its direction in the drive")
    elif abs(ratio - 1.0) > _ALIKE:
        outcome.faults.append(
            f"second encoder: 60E4h:1 tells {ratio:.4g} of the path of 6064h; where no gear is between them, "
            "60E6h, 60EBh, 60E8h, 60EDh, 60E9h or 60EEh is wrong"
        )


def _both(session: Session) -> tuple[int, int]:
    objects = session.objects
    return (
        objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i"),
        objects.read(Object.ADDITIONAL_POSITION, 1, "i"),
    )


def _moved(before: int, after: int) -> int:
    return (after - before + _HALF) % _WRAP - _HALF
