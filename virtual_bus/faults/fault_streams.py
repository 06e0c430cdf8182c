"""Random streams that do not disturb one another: one for each fault on each link.

A stream depends only on the seed and on its own name, so that to change, add or take away
another fault, or another node, leaves it as it was. Only the raw output of PCG64 is used:
numpy keeps that the same for ever, on every machine.
"""

from collections.abc import Callable
from functools import partial
from hashlib import blake2b
from typing import Final, Self

import numpy as np

from servobench.virtual_bus.core.native import UniformNumbers

BLOCK: Final = 512
"""Numbers drawn at a time: a single draw from numpy costs as much as fifty from a block."""

_RESOLUTION: Final = 2.0**-53


class UniformStream(UniformNumbers):
    """Numbers even in [0, 1), drawn a block at a time."""

    def __new__(cls, seed: int, name: str) -> Self:
        """``name``: tells the streams of one seed apart."""
        digest = blake2b(name.encode(), digest_size=16).digest()
        source = np.random.PCG64(np.random.SeedSequence([seed, int.from_bytes(digest, "little")]))
        return super().__new__(cls, partial(_block, source))


def _block(source: np.random.PCG64) -> bytes:
    raw = source.random_raw(BLOCK)
    return ((raw >> np.uint64(11)) * _RESOLUTION).tobytes()


def uniform_stream(seed: int, name: str, suffix: str = "") -> Callable[[], float]:
    """The stream called ``name`` and ``suffix``: each call gives the next number."""
    return UniformStream(seed, name + suffix).draw
