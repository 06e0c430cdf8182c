"""Certificates, Table 2 of [Ling2012] and Monte Carlo, part by part: ``bench_design loops --seconds 600``.

Without a part named, those that take seconds. ``loops``, ``peaks`` and ``table`` take minutes.
"""

import argparse
import timeit
from collections.abc import Callable, Iterator

import numpy as np

from servobench.design.delay.certificate import certified_gain
from servobench.design.delay.delay_loop import Units
from servobench.design.delay.delay_norm import hinf_norm
from servobench.design.papers.as_printed import theorem_3_3
from servobench.design.papers.ling2012 import DELAY_S, MODEL, MOTOR, PERIOD_S, TABLE_2, TAU_S, K, table2_row
from servobench.design.sampled.analysis import regular_patterns, worst_peak
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import worst_gain
from servobench.design.sampled.peak_certificate import certify_peak
from servobench.design.sampled.sequence_certificate import certify_decay, certify_gain
from servobench.design.speed.monte_carlo import Chance, run_many
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.benchmarks.bench_hub_cycle import cpu_s
from tests.unit.design.random_loops import order_is_found, random_bounds
from tests.unit.design.random_peaks import peaks_of

REPEATS = 30
RUNS = 10_000
RANDOM_LOOPS, RANDOM_PEAKS = 200, 30
CLOCK = MonotonicClock()


class Budget:
    """The time of one part."""

    def __init__(self, seconds: float, first: int) -> None:
        self._until = CLOCK.now() + seconds * NS_PER_S
        self._first = first

    @property
    def spent(self) -> bool:
        """Nothing is left."""
        return CLOCK.now() >= self._until

    def numbers(self, count: int) -> Iterator[int]:
        """Numbers from the first that is wanted to ``count``, as long as there is time."""
        for number in range(self._first, count + 1):
            if self.spent:
                return
            yield number

    def report(self, name: str, work: Callable[[], object], repeats: int = REPEATS) -> float:
        """Print p50, p99 and max of ``work`` in ms, repeated while there is time; returns p50."""
        work()
        taken: list[float] = []
        while len(taken) < repeats and not (taken and self.spent):
            taken.append(1e3 * timeit.timeit(work, number=1))
        p50, p99 = np.percentile(taken, [50, 99])
        say(f"{name:<44} p50 {p50:9.3f} ms   p99 {p99:9.3f} ms   max {max(taken):9.3f} ms   of {len(taken)}")
        return float(p50)


def say(line: str) -> None:
    """A line that a pipe sees at once."""
    print(line, flush=True)


def certificates(budget: Budget) -> None:
    """Of the printed controller at 64 ms, and how long (3.10) takes in cvxpy."""
    loop = MODEL.loop(K, DELAY_S)
    budget.report("exact norm to 1e-8", lambda: hinf_norm(loop))
    # No problem is kept: to build one costs less than to solve it, and so another plant costs the same.
    ours = {
        order: budget.report(f"certificate of order {order}, built, solved, checked", certify)
        for order in range(4)
        for certify in [lambda order=order: certified_gain(MODEL, loop, order)]
    }
    scale = 1.2 * hinf_norm(loop)
    theirs = budget.report(
        "(3.10) in cvxpy, built and solved", lambda: theorem_3_3(loop, MODEL.state_scale, scale), 5
    )
    say(f"certificate of order 0: {theirs / ours[0]:.1f} x faster than the cvxpy formulation of the same run")


def sampled(budget: Budget) -> None:
    """Search and certificates of the printed controller as it runs, over 5 losses in a row and 0 to 4 ms."""
    network = SampledNetwork(Strategy.ARRIVAL, PERIOD_S, 5, TAU_S)
    loop = HeldLoop(MODEL, K, network)
    regular = regular_patterns(loop)
    worst = worst_gain(loop, regular)
    patterns = [worst.pattern, *regular]
    budget.report("sampled loop: search for the worst pattern", lambda: worst_gain(loop, regular), 3)
    budget.report(
        "sampled loop: certificate of the gain", lambda: certify_gain(loop, patterns, worst.gain), 3
    )
    budget.report(
        "sampled loop: certificate of the decay", lambda: certify_decay(loop, patterns, worst.gain), 3
    )
    decay, peak = min(each.decay_per_s for each in patterns), worst_peak(loop)
    budget.report(
        "sampled loop: certificate of the peak",
        lambda: certify_peak(loop, patterns, worst.gain, 0.999 * decay, peak),
        3,
    )


def orders(budget: Budget) -> None:
    """Certificates of an asked order, 0 to 4, of 200 stable loops with a constant delay."""
    draw = np.random.default_rng(5)
    found = [order_is_found(draw) for _ in budget.numbers(RANDOM_LOOPS)]
    say(f"{len(found)} random stable loops: the certificate of the asked order found for {sum(found)}")


def loops(budget: Budget) -> None:
    """Certified beside found, of 200 random sampled loops: never below it."""
    gaps: list[float] = []
    uncertified = 0
    for number in budget.numbers(RANDOM_LOOPS):
        began = CLOCK.now()
        found, bound = random_bounds(np.random.default_rng([7, number]))
        took = (CLOCK.now() - began) / NS_PER_S
        if bound is None:
            uncertified += 1
            say(f"loop {number:3}: found {found:8.3f}, none certified; {took:.1f} s")
            continue
        gaps.append(100.0 * (bound / found - 1.0))
        say(f"loop {number:3}: found {found:8.3f}, certified {bound:8.3f}: {gaps[-1]:+.2f} %; {took:.1f} s")
    if gaps:
        below = sum(gap < 0.0 for gap in gaps)
        say(
            f"{len(gaps) + uncertified} random sampled loops: {len(gaps)} certified, {below} of them below "
            f"what is found; gap p50 {np.median(gaps):.2f} %, max {max(gaps):.1f} %"
        )


def peaks(budget: Budget) -> None:
    """Largest error after a load step of 30 loops: certified, found and by brute force."""
    bounds = []
    for number in budget.numbers(RANDOM_PEAKS):
        certified, found, brute = peaks_of(number - 1)
        say(f"loop {number:3}: found {found:8.3f}, brute force {brute:8.3f}, certified {certified:8.3f}")
        bounds.append((certified, found, brute))
    if bounds:
        highs, founds, brutes = np.array(bounds).T
        below = np.count_nonzero(highs < np.maximum(founds, brutes))
        gaps = 100.0 * (highs / founds - 1.0)
        say(
            f"{len(bounds)} random sampled loops: certified peak below found or brute force {below} times; "
            f"gap p50 {np.median(gaps):.2f} %, max {gaps.max():.1f} %"
        )


def monte_carlo(budget: Budget) -> None:
    """10^4 runs of 1 s over a lossy network, with an uncertain plant, and as many at 1 kHz."""
    for period_s, losses, tau_s in ((PERIOD_S, 5, TAU_S), (0.001, 2, 0.0005)):
        network = SampledNetwork(Strategy.ARRIVAL, period_s, losses, tau_s)
        chance = Chance(RUNS, seed=1, loss_probability=0.2, uncertainty=0.2)
        took = budget.report(
            f"Monte Carlo, {RUNS} runs of 1 s at {1 / period_s:g} Hz", _runs(network, chance), 5
        )
        say(f"  {RUNS / took * 1e3:.0f} runs/s")


def _runs(network: SampledNetwork, chance: Chance) -> Callable[[], object]:
    return lambda: run_many(MOTOR, K, network, chance)


def row(_: Budget) -> None:
    """One row of Table 2 in one convention."""
    took = timeit.timeit(lambda: table2_row(*TABLE_2[5], Units.PUBLISHED), number=1, timer=cpu_s)
    say(f"Table 2, one row by every method: {took:.1f} s of processor time; all of it: the part table")


def table(budget: Budget) -> None:
    """Table 2 row by row, 11 in each of 2 conventions, on one process."""
    rows = [(*printed, units) for units in (Units.PUBLISHED, Units.SI) for printed in TABLE_2]
    taken: list[float] = []
    for number in budget.numbers(len(rows)):
        error, delay_s, units = rows[number - 1]
        each = timeit.timeit(lambda: table2_row(error, delay_s, units), number=1, timer=cpu_s)  # noqa: B023
        taken.append(each)
        say(f"row {number:2}: {error} %, {units.value}: {taken[-1]:.1f} s")
    say(f"Table 2, {len(taken)} of {len(rows)} rows by every method: {sum(taken):.1f} s of processor time")


QUICK = {
    "certificates": certificates,
    "orders": orders,
    "sampled": sampled,
    "monte-carlo": monte_carlo,
    "row": row,
}
PARTS = QUICK | {"loops": loops, "peaks": peaks, "table": table}


def main() -> None:
    """The parts that are named, in the order of their names here."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="\n".join(f"{name:<14}{part.__doc__}" for name, part in PARTS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--seconds", type=float, default=600.0, help="at most, for each part (%(default)g)")
    parser.add_argument("--first", type=int, default=1, help="loop to begin with, to go on with a part")
    arguments = parser.parse_args()
    unknown = set(arguments.parts) - set(PARTS)
    if unknown:
        parser.error(f"no part is named {', '.join(sorted(unknown))}: {', '.join(PARTS)}")
    for name in PARTS:
        if name in (arguments.parts or QUICK):
            PARTS[name](Budget(arguments.seconds, arguments.first))


if __name__ == "__main__":
    main()
