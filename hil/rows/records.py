"""Rows of cycle records as numpy has them, and what of them the digest covers."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.hil.loop.cycle_record import COLUMNS, NAMES

DIGESTED: Final = tuple(
    [place for place, name in enumerate(NAMES) if name != "compute_ns" and not name.startswith("channel_")]
)
"""Places of the columns that the digest covers; every one has eight bytes. In simulated time they follow from
the bench file and the seed, unlike the host's computing time and a user controller's channels."""
DIGESTED_TO_FORMAT_2: Final = tuple(range(NAMES.index("compute_ns")))
"""The same of recordings of formats 1 and 2: without the last four columns."""

ROW_DTYPE: Final = np.dtype([(column.name, "<f8" if column.is_real else "<i8") for column in COLUMNS])
"""A packed row. A real number that there is none of is NaN, a whole number NOTHING."""

Rows = NDArray[np.void]
"""(n,) of ROW_DTYPE."""
