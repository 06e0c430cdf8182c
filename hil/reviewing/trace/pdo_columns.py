"""PDOs of one identifier as columns: their mapped objects as numbers, by numpy."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.objects301 import FIRST_OBJECT
from servobench.hil.reviewing.trace.pdo_book import MappedField, PdoLayout

Integers = NDArray[np.int64]
_WORD_BITS: Final = 64


class ObjectColumn(NamedTuple):
    """An object in the PDOs of one identifier."""

    key: tuple[int, int]
    """Index and sub-index."""
    raw: NDArray[np.int64 | np.uint64 | np.float64]
    """(n,), as the object's type has it."""


def columns_of(layout: PdoLayout, data: NDArray[np.uint8], length: int) -> Iterator[ObjectColumn]:
    """Yield the objects of ``data``: (n, 8), of which ``length`` bytes came; gaps and what does not fit into
    them are left out."""
    words = np.ascontiguousarray(data).view("<u8").reshape(-1)
    for field in layout.objects or ():
        if field.index >= FIRST_OBJECT and field.shift + field.bits <= 8 * length:
            yield ObjectColumn((field.index, field.sub), _numbers(words, field))


def _numbers(words: NDArray[np.uint64], field: MappedField) -> NDArray[np.int64 | np.uint64 | np.float64]:
    bits = field.bits
    if not bits:
        return np.zeros(words.size, np.int64)
    if bits == _WORD_BITS and field.shift == 0:
        values = words
    else:
        values = words >> np.uint64(field.shift) & np.uint64((1 << bits) - 1)
    if field.real and bits == 32:
        return values.astype(np.uint32).view(np.float32).astype(np.float64)
    if field.real and bits == _WORD_BITS:
        return np.ascontiguousarray(values).view(np.float64)
    if not field.signed:
        return values if bits == _WORD_BITS else values.astype(np.int64)
    lift = np.uint64(_WORD_BITS - bits)
    return (values << lift).view(np.int64) >> np.int64(_WORD_BITS - bits)
