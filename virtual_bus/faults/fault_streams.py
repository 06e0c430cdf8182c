"""Random streams that do not disturb one another: one for each fault on each link.

A stream depends only on the seed and on its own name, so that to change, add or take away
another fault, or another node, leaves it as it was. Only the raw output of PCG64 is used:
numpy keeps that the same for ever, on every machine.
"""

from collections.abc import Callable
from hashlib import blake2b
from typing import Final

import numpy as np
from librt.strings import read_f64_le

BLOCK: Final = 512
"""Numbers drawn at a time: a single draw from numpy costs as much as fifty from a block."""

_RESOLUTION: Final = 2.0**-53


class UniformStream:
    """Numbers even in [0, 1), drawn a block at a time."""

    __slots__ = ("_next", "_numbers", "_source")

    def __init__(self, seed: int, name: str) -> None:
        digest = blake2b(name.encode(), digest_size=16).digest()
        self._source = np.random.PCG64(np.random.SeedSequence([seed, int.from_bytes(digest, "little")]))
        self._numbers = b""
        self._next = 0

    def draw(self) -> float:
        """The next number."""
        place = self._next
        if place == len(self._numbers) >> 3:
            raw = self._source.random_raw(BLOCK)
            self._numbers = ((raw >> np.uint64(11)) * _RESOLUTION).astype("<f8").tobytes()
            place = 0
        self._next = place + 1
        return read_f64_le(self._numbers, place << 3)


def uniform_stream(seed: int, name: str, suffix: str = "") -> Callable[[], float]:
    """The stream called ``name`` and ``suffix``: each call gives the next number."""
    return UniformStream(seed, name + suffix).draw
