"""Raw frames as a log that candump -L would write: can-utils, Wireshark, python-can and SavvyCAN read it.

    (1436509052.249713) can0 123#11223344

Which of them the bench sent has no place in that format: Wireshark refuses a line with more in it. It is told
line by line beside it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.timebase import NS_PER_US
from drivers.wire.identifiers import EXTENDED_FLAG, REMOTE_FLAG
from hil.rows.run_files import DIRECTION_BYTES

_IDENTIFIER_MASK = (1 << 30) - 1
"""The highest of these bits marks an error frame (CAN_ERR_FLAG)."""
_US_PER_S = 1_000_000


def candump_lines(
    rows: NDArray[np.void], interface: str, wall_offset_ns: int, segments: Sequence[str] = ()
) -> bytes:
    """The lines of ``rows``: (n,) of FRAME_DTYPE. The stamp is ``at`` + ``wall_offset_ns``, to 1 us.

    ``segments``: names of those after the first one, whose frames bear their own name for an interface.
    """
    names = (interface, *segments)
    stamps_us = ((rows["at"] + wall_offset_ns) // NS_PER_US).tolist()
    identifiers, lengths = rows["can_id"].tolist(), rows["length"].tolist()
    numbers, digits = (rows["sent"] >> 1).tolist(), rows["data"].tobytes().hex().upper()
    lines = []
    for row, (at_us, can_id) in enumerate(zip(stamps_us, identifiers, strict=True)):
        stamp = f"({at_us // _US_PER_S:010d}.{at_us % _US_PER_S:06d})"
        identifier = f"{can_id & _IDENTIFIER_MASK:0{8 if can_id & EXTENDED_FLAG else 3}X}"
        data = "R" if can_id & REMOTE_FLAG else digits[16 * row : 16 * row + 2 * lengths[row]]
        lines.append(f"{stamp} {names[numbers[row]]} {identifier}#{data}\n")
    return "".join(lines).encode()


def direction_lines(rows: NDArray[np.void]) -> bytes:
    """A line for each of ``rows``, (n,) of FRAME_DTYPE: T was sent by the bench, R was received by it."""
    lines = np.full((rows.size, DIRECTION_BYTES), ord("\n"), np.uint8)
    lines[:, 0] = np.where(rows["sent"] & 1, ord("T"), ord("R"))
    return lines.tobytes()
