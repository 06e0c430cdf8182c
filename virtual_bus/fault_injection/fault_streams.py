"""Random streams that do not disturb one another: one for each fault on each link.

A stream depends only on the seed and on its own name, so that to change, add or take away
another fault, or another node, leaves it as it was. Only the raw output of PCG64 is used:
numpy keeps that the same for ever, on every machine.
"""

from collections.abc import Callable, Iterator
from hashlib import blake2b
from typing import Final

import numpy as np

BLOCK: Final = 512
"""Numbers drawn at a time: a single draw from numpy costs as much as fifty from a list."""

_RESOLUTION: Final = 2.0**-53


def uniform_stream(seed: int, name: str) -> Callable[[], float]:
    """The stream called ``name``: each call gives the next number, even in [0, 1)."""
    return _numbers(seed, name).__next__


def _numbers(seed: int, name: str) -> Iterator[float]:
    digest = blake2b(name.encode(), digest_size=16).digest()
    source = np.random.PCG64(np.random.SeedSequence([seed, int.from_bytes(digest, "little")]))
    while True:
        raw = source.random_raw(BLOCK)
        yield from ((raw >> np.uint64(11)) * _RESOLUTION).tolist()
