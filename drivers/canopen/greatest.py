"""Finds the greatest value that a device accepts when it refuses the one wanted as too great."""

import math
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.sdo import object_name
from servobench.drivers.errors import TransferAborted

_TOO_LOW: Final = 0x06090032
_TOO_GREAT: Final = frozenset({0x06090030, 0x06090031})
"""Value range exceeded, value too high (CiA 301 table 22)."""
_TRIES: Final = 24
"""Steps of the bisection: exact up to some 60 000, and within a hundred-thousandth of 2^32."""


class Granted(NamedTuple):
    """The value that a device holds instead of the one wanted."""

    held: int | None
    """None: it does not have the object."""
    notes: list[str]
    """Remarks on what it refused."""


def write_greatest(
    objects: RemoteObjects,
    index: int,
    code: str,
    wanted: int,
    text: str,
    *,
    most: int | None = None,
    sub: int = 0,
) -> Granted:
    """Write ``wanted`` or, if that is refused as too great, the greatest value below it that the device
    accepts; read it back.

    ``most``: the limit in its data sheet. Without one the limit is found by bisection, in at most 24 writes.
    Raises NoAnswer.
    """
    name = object_name(index, sub)
    before = objects.read_if_there(index, sub, code)
    if before is None:
        return Granted(None, [f"{name} is missing: {text} left to the drive"])

    def refusal(value: int) -> TransferAborted | None:
        try:
            objects.write(index, sub, code, value)
        except TransferAborted as error:
            return error
        return None

    tried = wanted if most is None else min(wanted, most)
    first = None if tried == before else refusal(tried)
    if first is not None and first.code not in _TOO_GREAT:
        return Granted(before, [f"{name} refused {tried} ({text}): {first.evidence}"])
    low, high = before if before < tried else 0, tried
    for _ in range(_TRIES if first is not None else 0):
        if high - low <= 1:
            break
        middle = min(max(low + 1, round(math.sqrt(max(low, 1) * high))), high - 1)
        error = refusal(middle)
        if error is None or error.code == _TOO_LOW:
            low = middle
        elif error.code in _TOO_GREAT:
            high = middle
        else:
            break
    held = objects.read(index, sub, code)
    if held == wanted:
        return Granted(held, [])
    why = first.evidence if first is not None else "by its data sheet" if held == tried else "not taken"
    return Granted(held, [f"{name} holds {held}, {wanted} was asked for ({text}): {why}"])
