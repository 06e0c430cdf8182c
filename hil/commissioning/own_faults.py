"""Faults that an exercise itself may cause, and that pass: they are reset before the next attempt."""

from collections.abc import Sequence
from typing import Final, NamedTuple

from servobench.drivers.canopen.error_codes import HEARTBEAT_ERROR
from servobench.drivers.errors import DriveInFault, PeerFault


class _OwnFault(NamedTuple):
    cause: str
    """Empty: it may be a short circuit, and is not reset."""
    remedy: str = ""


_LOWER: Final = "lower limits.speed_max_rpm or limits.torque_max_percent in the nameplate"
_OWN_FAULTS: Final = {
    HEARTBEAT_ERROR: _OwnFault("of a host that was not heard"),
    0x3210: _OwnFault(
        "of a DC link that braking charged",
        f"braking returns more than the link takes: a braking resistor, or {_LOWER}",
    ),
    0x3220: _OwnFault(
        "of a DC link that driving emptied", f"the supply gives less than the motion takes: {_LOWER}"
    ),
    0x2350: _OwnFault("of I^2 t", "let it cool, or lower limits.torque_max_percent in the nameplate"),
    0x2310: _OwnFault("", _LOWER),
}


def passing_cause(codes: Sequence[int]) -> str | None:
    """Return the cause of the last of ``codes``; None if there is none, or an exercise does not cause it."""
    known = _OWN_FAULTS.get(codes[-1]) if codes else None
    return None if known is None else known.cause or None


def advise(failure: PeerFault | None, codes: Sequence[int]) -> None:
    """Give a drive's fault the remedy for the last of ``codes``, if an exercise causes that."""
    known = _OWN_FAULTS.get(codes[-1]) if codes else None
    if known is not None and known.remedy and isinstance(failure, DriveInFault):
        failure.remedy = known.remedy
