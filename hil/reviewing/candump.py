"""Raw frames as a log that candump -L would write: can-utils, Wireshark, python-can and SavvyCAN read it.

    (1436509052.249713) can0 123#11223344

Which of them the bench sent has no place in that format: Wireshark refuses a line with more in it. The lines
are made by columns, ~0.2 us each.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_US
from servobench.drivers.wire.identifiers import EXTENDED_FLAG, REMOTE_FLAG

_HEX = np.frombuffer(b"0123456789ABCDEF", np.uint8)
_IDENTIFIER_MASK = (1 << 30) - 1
"""The highest of these bits marks an error frame (CAN_ERR_FLAG)."""
_SECONDS_DIGITS = 10
"""Digits of Unix time in seconds, until the year 2286."""
_DIGIT_WEIGHTS = 10 ** np.arange(_SECONDS_DIGITS + 6 - 1, -1, -1, dtype=np.int64)


def candump_lines(rows: NDArray[np.void], interfaces: Sequence[str]) -> bytes:
    """The lines of ``rows``: (n,) of FRAME_DTYPE, their ``at`` ns since 1970, told to 1 us.

    ``interfaces``: names by segment.
    """
    if not rows.size:
        return b""
    count = rows.size
    extended = (rows["can_id"] & EXTENDED_FLAG) != 0
    remote = (rows["can_id"] & REMOTE_FLAG) != 0
    always = np.ones((count, 1), bool)
    parts: list[tuple[NDArray[np.uint8], NDArray[np.bool_]]] = []

    def text(letters: str, where: NDArray[np.bool_] = always) -> None:
        block = np.broadcast_to(np.frombuffer(letters.encode(), np.uint8), (count, len(letters)))
        parts.append((block, np.broadcast_to(where, block.shape)))

    stamp = _decimal_digits(rows["at"] // NS_PER_US)
    text("(")
    parts.append((stamp[:, :_SECONDS_DIGITS], np.broadcast_to(always, (count, _SECONDS_DIGITS))))
    text(".")
    parts.append((stamp[:, _SECONDS_DIGITS:], np.broadcast_to(always, (count, 6))))
    text(") ")
    for number, name in enumerate(interfaces):
        text(name, (rows["sent"] >> 1 == number)[:, None])
    text(" ")
    identifier = _hex_digits(rows["can_id"] & _IDENTIFIER_MASK)
    # a standard identifier has the last three digits, an extended one all eight
    parts.append(
        (identifier, np.concatenate((np.repeat(extended[:, None], 5, 1), np.repeat(always, 3, 1)), 1))
    )
    text("#")
    parts.append((np.full((count, 1), ord("R"), np.uint8), remote[:, None]))
    data = _HEX[np.stack((rows["data"] >> 4, rows["data"] & 15), 2)].reshape(count, 16)
    present = np.repeat(np.arange(8) < rows["length"][:, None], 2, 1) & ~remote[:, None]
    parts.append((data, present))
    text("\n")
    letters = np.concatenate([part for part, _ in parts], 1)
    lines: bytes = letters[np.concatenate([kept for _, kept in parts], 1)].tobytes()
    return lines


def _decimal_digits(values: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(n, 16) ASCII digits with leading zeros."""
    return (values[:, None] // _DIGIT_WEIGHTS % 10 + ord("0")).astype(np.uint8)


def _hex_digits(values: NDArray[np.integer]) -> NDArray[np.uint8]:
    """(n, 8) ASCII digits with leading zeros."""
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    letters: NDArray[np.uint8] = _HEX[(values[:, None] >> shifts) & 15]
    return letters
