"""Which rows of a drive without stamps have another explanation, from when its SYNCs and readings came.

A way to place the readings is possible if no SYNC has two of them, each delay is one that the run has shown,
and, where no reading overtook another, none does. SYNCs without a reading have lost theirs.

    SYNC ends    1      2      3      4
    readings         |a        |b             |c      delays: up to 1.4 periods, as that of c
    truth            1        lost    b is 3's
    another way      1        b was 2's, and 3 was lost: the rows of 2 and 3 have another explanation

No probability is asked, unlike in :mod:`tests.truth.oracle`, which weighs what is likelier: a row that has
no other way here is decidable by anybody who knows the least and the largest delay. The bench learns these
from the same readings, and marks its rows within 64 cycles.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from servobench.drivers.timebase import Instant
from tests.truth.truth import AxisTruth


def explained_otherwise(truth: AxisTruth) -> set[int]:
    """The instants at which SYNCs were handed over whose rows some other possible way explains too."""
    syncs = [sync for sync in truth.syncs if sync.on_bus_at is not None]
    ends = [sync.on_bus_at or Instant(0) for sync in syncs]
    places = [place for place, sync in enumerate(syncs) if sync.reading is not None]
    came_at = [sync.reading.received_at for sync in syncs if sync.reading is not None]
    if not places:
        return set()
    delays = [at - ends[place] for at, place in zip(came_at, places, strict=True)]
    first = [bisect_left(ends, at - max(delays)) for at in came_at]
    last = [bisect_right(ends, at - min(delays)) - 1 for at in came_at]
    if any(sync.overtaken for sync in syncs):
        open_to = _in_any_order(places, first, last, len(syncs))
    else:
        open_to = _in_order(places, first, last)
    return {int(syncs[place].handed_at) for place in open_to}


def _in_order(places: Sequence[int], first: Sequence[int], last: Sequence[int]) -> set[int]:
    """Places of SYNCs that can change if later readings are of later SYNCs; a reading at each of ``places``
    may be of ``first`` to ``last``."""
    earliest = list(accumulate(first, lambda before, own: max(before + 1, own)))
    latest = list(accumulate(reversed(last), lambda behind, own: min(behind - 1, own)))[::-1]
    return {
        other
        for own, low, high in zip(places, earliest, latest, strict=True)
        if low < high
        for other in (own, *range(low, high + 1))
    }


def _in_any_order(places: Sequence[int], first: Sequence[int], last: Sequence[int], syncs: int) -> set[int]:
    """The same where readings may overtake each other: a reading can change if it can push others on up to a
    SYNC that has none, or in a circle. Node ``syncs`` leads from those without one back to all readings."""
    pushes = {
        (own, other)
        for own, low, high in zip(places, first, last, strict=True)
        for other in range(low, high + 1)
        if other != own
    }
    pushes |= {(free, syncs) for free in set(range(syncs)).difference(places)}
    pushes |= {(syncs, own) for own in places}
    rows, columns = zip(*pushes, strict=True)
    graph = csr_array((np.ones(len(pushes)), (rows, columns)), shape=(syncs + 1, syncs + 1))
    _, circle_of = connected_components(graph, connection="strong")
    sizes = np.bincount(circle_of)
    return {place for place in range(syncs) if sizes[circle_of[place]] > 1}
