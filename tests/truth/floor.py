"""``python -m tests.truth.floor``: how many rows without stamps nobody could tell for certain.

    python -m tests.truth.floor --first 452441 --plans 500     told beside the least doubt there can be

One who knows more than any bench places the readings: the delays of the 64 before and behind each, whichever
SYNC they answered, the share that is lost, which readings are copies, and whether frames of the run overtake
each other at all. Bayes' rule over every way to place them, by sums forward and backward over the SYNCs that
have no reading yet, gives for each SYNC how likely its likeliest reading, or its loss, is not the true one:

    SYNC ends    1      2      3              open SYNCs after a: {1} or {2}; after b: {1, 3}, {2, 3}, ...
    readings         |a     |b    |c

The *floor* leaves in doubt the rows that are likeliest wrong, and so few that of the others one in
:data:`ROWS` is expected to be wrong. A bench that is as seldom wrong has no fewer in doubt.
"""

import argparse
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate
from typing import Final

from servobench.drivers.timebase import Duration
from tests.truth.drawn import drawn_plan
from tests.truth.drawn_bench import DrawnPlan
from tests.truth.drawn_run import CYCLES, bench_config, timing_of
from tests.truth.rows import READING_IS_A_SET, each_row, told_by
from tests.truth.tapped_run import Surroundings, run_with_taps
from tests.truth.truth import AxisTruth, SyncTruth, axis_truth, passages

ROWS: Final = 1_000_000
NEAR: Final = 64
"""Readings to either side whose delays are known: rows of a bench wait for as many."""
ALIKE_PARTS: Final = 64
"""Delays within such a part of a period are alike."""
Weights = dict[int, float]
Step = tuple[int, int, Weights]
"""What happened: the newest SYNC; the reading, or -1 for a further SYNC; what the reading may answer."""


def errors_of(truth: AxisTruth, period: Duration) -> dict[int, float]:
    """Of each SYNC, by the instant at which it was handed over, how likely its likeliest row is wrong."""
    syncs = [sync for sync in truth.syncs if sync.on_bus_at is not None]
    answered = [place for place, sync in enumerate(syncs) if sync.reading is not None]
    if len(answered) < 2:
        return {}
    lost = (len(syncs) - len(answered) + 1) / (len(syncs) + 2)
    in_order = not any(sync.overtaken for sync in syncs)
    likely = _posteriors(_steps(syncs, answered, period // ALIKE_PARTS), lost, in_order)
    came, best = [0.0] * len(syncs), [0.0] * len(syncs)
    for posterior in likely:
        for number, share in posterior.items():
            came[number] += share
            best[number] = max(best[number], share)
    return {
        int(sync.handed_at): max(0.0, 1.0 - max(best[place], 1.0 - came[place]))
        for place, sync in enumerate(syncs)
    }


def least_doubt(errors: Sequence[float], rows: int = ROWS) -> int:
    """How many rows are to be in doubt so that of the others one in ``rows`` is expected to be wrong."""
    certain = sum(total * rows <= len(errors) for total in accumulate(sorted(errors)))
    return len(errors) - certain


def _steps(syncs: list[SyncTruth], answered: list[int], alike: int) -> list[Step]:
    """SYNCs and readings in order of time; a reading's weights say how many delays near it are alike."""
    ends = [sync.on_bus_at or 0 for sync in syncs]
    came = [sync.reading.received_at for sync in syncs if sync.reading is not None]
    found = sorted((at, at - ends[place]) for at, place in zip(came, answered, strict=True))
    steps: list[Step] = []
    newest = -1
    for reading, (at, _) in enumerate(found):
        near = sorted(delay for _, delay in found[max(0, reading - NEAR) : reading + NEAR + 1])
        while newest + 1 < len(ends) and ends[newest + 1] <= at:
            newest += 1
            steps.append((newest, -1, {}))
        weights = {
            number: float(count)
            for number in range(bisect_left(ends, at - near[-1] - alike), newest + 1)
            if (
                count := bisect_right(near, at - ends[number] + alike)
                - _before(near, at, ends[number], alike)
            )
        }
        steps.append((newest, reading, weights))
    return [*steps, *((number, -1, Weights()) for number in range(newest + 1, len(ends)))]


def _before(near: list[int], at: int, end: int, alike: int) -> int:
    return bisect_left(near, at - end - alike)


def _posteriors(steps: list[Step], lost: float, in_order: bool) -> list[Weights]:
    """Of each reading, how likely it answers each SYNC."""
    depth = 1 + max(newest - min(weights) for newest, _, weights in steps if weights)
    forward = [{(1 << depth) - 1: 1.0}]
    """After each step, the weights of the sets of SYNCs that have a reading; bit 0 is the newest."""
    for newest, reading, weights in steps:
        ahead: Weights = {}
        for had, share in forward[-1].items():
            for has, _, factor in _ways(had, newest, reading, weights, depth, lost, in_order):
                ahead[has] = ahead.get(has, 0.0) + share * factor
        forward.append(_scaled(ahead))
    backward = {
        has: (1.0 - lost) ** has.bit_count() * lost ** (depth - has.bit_count()) for has in forward[-1]
    }
    found: list[Weights] = []
    for before, (newest, reading, weights) in zip(reversed(forward[:-1]), reversed(steps), strict=True):
        behind, placed = Weights(), Weights()
        for had, share in before.items():
            for has, number, factor in _ways(had, newest, reading, weights, depth, lost, in_order):
                likely = factor * backward.get(has, 0.0)
                behind[had] = behind.get(had, 0.0) + likely
                placed[number] = placed.get(number, 0.0) + share * likely
        backward = _scaled(behind)
        if reading >= 0:
            found.append(_scaled(placed))
    return found[::-1]


def _ways(
    had: int, newest: int, reading: int, weights: Weights, depth: int, lost: float, in_order: bool
) -> list[tuple[int, int, float]]:
    """What may come of a set of SYNCs that had readings: the set, the SYNC that is answered, the factor."""
    if reading < 0:
        oldest = had >> (depth - 1) & 1
        return [(had << 1 & (1 << depth) - 1, -1, 1.0 - lost if oldest else lost)]
    ways = []
    for number in range(newest, newest - depth, -1):
        bit = 1 << (newest - number)
        if had & bit and in_order:
            break
        if not had & bit and number in weights:
            ways.append((had | bit, number, weights[number]))
    return ways


def _scaled(shares: Weights) -> Weights:
    total = sum(shares.values())
    return {number: share / total for number, share in shares.items()} if total else shares


def main() -> None:
    """The floor of plans without stamps whose delays are below two periods, beside what a run tells."""
    parser = argparse.ArgumentParser(prog="python -m tests.truth.floor", description=main.__doc__)
    parser.add_argument("--first", type=int, default=1, help="the seed of the first plan; the others follow")
    parser.add_argument("--plans", type=int, default=100, help="so many seeds, of which few are such plans")
    parser.add_argument("--cycles", type=int, default=CYCLES, help="of each axis of a plan")
    given = parser.parse_args()
    errors: list[float] = []
    unsure = plans = 0
    for seed in range(given.first, given.first + given.plans):
        plan = drawn_plan(seed)
        if plan.has_stamps or not plan.delays_are_short:
            continue
        of_rows, doubted = _of_plan(plan, given.cycles)
        plans, unsure = plans + 1, unsure + doubted
        errors += of_rows
        print(f"seed {seed}: {len(of_rows)} rows, {doubted} unsure, floor {least_doubt(of_rows)}", flush=True)
    rows = max(1, len(errors))
    print(
        f"\n{plans} plans, {len(errors)} rows; told unsure {100 * unsure / rows:.2f} %; least doubt there is:"
    )
    for wrong in (1000, 10_000, ROWS):
        print(f"  one wrong in {wrong:7}: {100 * least_doubt(errors, wrong) / rows:.2f} %")


def _of_plan(plan: DrawnPlan, cycles: int) -> tuple[list[float], int]:
    """Of each row of a plan, how likely the best answer is wrong; and how many it told as uncertain."""
    config = bench_config(plan, cycles)
    run = run_with_taps(config, Surroundings(plan.clock_starts_at_us, plan.adapter))
    timing, seen = timing_of(plan, config), passages(run.log, plan.heard)
    errors: list[float] = []
    unsure = 0
    for axis, name in enumerate(config.axes):
        truth = axis_truth(run.log, config.drive[name].node, READING_IS_A_SET, plan.heard, seen)
        told = told_by(run.rows, axis, timing.period)
        period = Duration(plan.producer_period_us * 1000) if plan.sync == "foreign" else timing.period
        of_sync = errors_of(truth, period)
        errors += [of_sync.get(int(row["sync_handed_at"]), 0.0) for row in each_row(told)]
        unsure += int((told["certain"] == 0).sum())
    return errors, unsure


if __name__ == "__main__":
    main()
