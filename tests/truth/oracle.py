"""Which rows of a drive without stamps nobody could decide, from when its SYNCs and readings came.

The oracle knows more than any bench: the delays of the 64 readings before and behind each one, how many are
lost, and, as a gift, which readings overtook others and which came twice. What is left keeps its order:

    SYNC ends    1      2      3      4
    readings         |a        |b        |c        a: 1;  b: 2 or 3;  c: 3 or 4;  one was lost

So all ways to place them are weighed by forward-backward sums: each reading by how many of the delays near it
are as its own would be, each SYNC passed over by the share that is lost. A row is *undecidable* if what
happened is not likelier than all else together by :data:`ODDS`. A bench asks for more and knows less,
so of these none can be told without the risk of wrong ones.
"""

from bisect import bisect_left, bisect_right
from typing import Final

from servobench.drivers.timebase import Duration
from tests.truth.truth import AxisTruth, SyncTruth

ODDS: Final = 1000.0
NEAR: Final = 64
"""Readings to either side whose delays are known: rows of a bench wait for as many."""
ALIKE_PARTS: Final = 64
"""Delays within such a part of a period are alike."""


def undecidable(truth: AxisTruth, period: Duration) -> set[int]:
    """The instants at which SYNCs were handed over whose rows nobody could decide."""
    syncs = [sync for sync in truth.syncs if sync.on_bus_at is not None and not sync.overtaken]
    answered = [place for place, sync in enumerate(syncs) if sync.reading is not None]
    if len(answered) < 2:
        return set()
    lost = (len(syncs) - len(answered) + 1) / (len(syncs) + 2)
    weights = _weights(syncs, answered, period // ALIKE_PARTS)
    likely = _posteriors(weights, lost)
    came = [0.0] * len(syncs)
    """That a SYNC has one of the readings."""
    true: dict[int, float] = {}
    for place, posterior in zip(answered, likely, strict=True):
        for number, share in posterior.items():
            came[number] += share
        true[place] = posterior.get(place, 0.0)
    doubtful = set()
    for place, sync in enumerate(syncs):
        if true.get(place, 1.0 - came[place]) < 1.0 - 1.0 / ODDS:
            doubtful.add(int(sync.handed_at))
    return doubtful


def _weights(syncs: list[SyncTruth], answered: list[int], alike: int) -> list[dict[int, float]]:
    """Of each reading, the SYNCs that it may answer, and how many of the delays near it are alike."""
    ends = [sync.on_bus_at or 0 for sync in syncs]
    came_at = [sync.reading.received_at for sync in syncs if sync.reading is not None]
    delays = [at - ends[place] for at, place in zip(came_at, answered, strict=True)]
    weights = []
    for index, at in enumerate(came_at):
        near = sorted(delays[max(0, index - NEAR) : index + NEAR + 1])
        first = bisect_left(ends, at - near[-1] - alike)
        last = bisect_right(ends, at - near[0] + alike)
        counts = {
            number: bisect_right(near, at - ends[number] + alike)
            - bisect_left(near, at - ends[number] - alike)
            for number in range(first, last)
        }
        weights.append({number: float(count) for number, count in counts.items() if count})
    return weights


def _posteriors(weights: list[dict[int, float]], lost: float) -> list[dict[int, float]]:
    """Of each reading, how likely it answers each SYNC, if later readings answer later ones."""
    forward: list[dict[int, float]] = []
    for each in weights:
        forward.append(_scaled(_passed(forward[-1], each, lost, 1) if forward else each))
    backward = [dict.fromkeys(weights[-1], 1.0)]
    for now, later in zip(reversed(weights[:-1]), reversed(weights[1:]), strict=True):
        behind = {number: backward[-1].get(number, 0.0) * weight for number, weight in later.items()}
        backward.append(_scaled(_passed(behind, dict.fromkeys(now, 1.0), lost, -1)))
    backward.reverse()
    return [
        _scaled({number: share * back.get(number, 0.0) for number, share in ahead.items()})
        for ahead, back in zip(forward, backward, strict=True)
    ]


def _passed(before: dict[int, float], weights: dict[int, float], lost: float, way: int) -> dict[int, float]:
    """``weights``, each times the sum of those ``before`` it, by ``lost`` for each SYNC between; ``way``: 1
    from the first to the last, -1 back."""
    return {
        number: weight
        * sum(
            share * lost ** (way * (number - other) - 1)
            for other, share in before.items()
            if way * (number - other) > 0
        )
        for number, weight in weights.items()
    }


def _scaled(shares: dict[int, float]) -> dict[int, float]:
    total = sum(shares.values())
    return {number: share / total for number, share in shares.items()} if total else shares
