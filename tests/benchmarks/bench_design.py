"""Certificates, Table 2 of [Ling2012] and Monte Carlo; ``--whole-table`` and ``--random`` take minutes."""

import sys
import timeit
from collections.abc import Callable

import numpy as np

from design.delay.certificate import certified_gain
from design.delay.delay_norm import hinf_norm
from design.delay.speed_loop import Units
from design.papers.as_printed import theorem_3_3
from design.papers.ling2012 import DELAY_S, MODEL, MOTOR, PERIOD_S, TABLE_2, TAU_S, K, table2_row
from design.sampled.analysis import regular_patterns
from design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from design.sampled.loss_patterns import worst_gain
from design.sampled.peak_certificate import certify_peak
from design.sampled.sequence_certificate import certify_decay, certify_gain
from design.sampled.worst_peak import worst_peak
from design.speed.monte_carlo import Chance, Uncertainty, run_many
from hil.studies.papers.reproduction import table2
from tests.unit.design.random_loops import order_is_found, random_bounds
from tests.unit.design.random_peaks import peaks_of

REPEATS = 30
RUNS = 10_000


def report(name: str, work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Print p50, p99 and max of ``work`` in ms; returns p50."""
    work()
    times = 1e3 * np.array(timeit.repeat(work, number=1, repeat=repeats))
    p50, p99 = np.percentile(times, [50, 99])
    print(f"{name:<44} p50 {p50:9.3f} ms   p99 {p99:9.3f} ms   max {times.max():9.3f} ms")
    return float(p50)


def main() -> None:
    """The printed controller at 64 ms."""
    loop = MODEL.loop(K, DELAY_S)
    report("exact norm to 1e-8", lambda: hinf_norm(loop))
    # No problem is kept: to build one costs less than to solve it, and so another plant costs the same.
    ours = {
        order: report(f"certificate of order {order}, built, solved, checked", certify)
        for order in range(4)
        for certify in [lambda order=order: certified_gain(MODEL, loop, order)]
    }
    scale = 1.2 * hinf_norm(loop)
    theirs = report(
        "(3.10) in cvxpy, built and solved", lambda: theorem_3_3(loop, MODEL.state_scale, scale), 5
    )
    print(
        f"certificate of order 0: {theirs / ours[0]:.1f} x faster than the cvxpy formulation of the same run"
    )
    random_orders()
    sampled()
    monte_carlo()
    if "--random" in sys.argv[1:]:
        random_loops()
        random_peaks()
    table("--whole-table" in sys.argv[1:])


def sampled() -> None:
    """Search and certificates of the printed controller as it runs, over 5 losses in a row and 0 to 4 ms."""
    network = SampledNetwork(Strategy.ARRIVAL, PERIOD_S, 5, TAU_S)
    loop = HeldLoop(MODEL, K, network)
    regular = regular_patterns(loop)
    worst = worst_gain(loop, regular)
    patterns = [worst.pattern, *regular]
    report("sampled loop: search for the worst pattern", lambda: worst_gain(loop, regular), 3)
    report("sampled loop: certificate of the gain", lambda: certify_gain(loop, patterns, worst.gain), 3)
    report("sampled loop: certificate of the decay", lambda: certify_decay(loop, patterns, worst.gain), 3)
    decay, peak = min(each.decay_per_s for each in patterns), worst_peak(loop).peak
    report(
        "sampled loop: certificate of the peak",
        lambda: certify_peak(loop, patterns, worst.gain, 0.999 * decay, peak),
        3,
    )


def random_orders(count: int = 200) -> None:
    """Certificates of an asked order, 0 to 4, of stable loops with a constant delay."""
    draw = np.random.default_rng(5)
    found = sum(order_is_found(draw) for _ in range(count))
    print(f"{count} random stable loops: the certificate of the asked order found for {found}")


def random_loops(count: int = 200) -> None:
    """Certified beside found: never below it."""
    draw = np.random.default_rng(7)
    bounds = [random_bounds(draw) for _ in range(count)]
    certified = [(found, bound) for found, bound in bounds if bound is not None]
    gaps = np.array([bound / found - 1.0 for found, bound in certified])
    below = np.count_nonzero(gaps < 0.0)
    print(
        f"{count} random sampled loops: {len(certified)} certified, {below} of them below what is found; "
        f"gap p50 {100 * np.median(gaps):.2f} %, max {100 * gaps.max():.1f} %"
    )


def random_peaks(count: int = 30) -> None:
    """Largest error after a load step: certified beside found and beside brute force over every pattern."""
    bounds = np.array([peaks_of(seed) for seed in range(count)])
    certified, found, brute = bounds.T
    below = np.count_nonzero(certified < np.maximum(found, brute))
    gaps = 100.0 * (certified / found - 1.0)
    print(
        f"{count} random sampled loops: certified peak below found or brute force {below} times; "
        f"gap p50 {np.median(gaps):.2f} %, max {gaps.max():.1f} %"
    )


def monte_carlo() -> None:
    """10^4 runs of 1 s over a lossy network, with an uncertain plant, and as many at 1 kHz."""
    widths = Uncertainty(0.2, 0.2, 0.2, 0.2, 0.2)
    for period_s, losses, tau_s in ((PERIOD_S, 5, TAU_S), (0.001, 2, 0.0005)):
        network = SampledNetwork(Strategy.ARRIVAL, period_s, losses, tau_s)
        chance = Chance(RUNS, seed=1, loss_probability=0.2, uncertainty=widths)
        took = report(f"Monte Carlo, {RUNS} runs of 1 s at {1 / period_s:g} Hz", _runs(network, chance), 5)
        print(f"  {RUNS / took * 1e3:.0f} runs/s")


def _runs(network: SampledNetwork, chance: Chance) -> Callable[[], object]:
    return lambda: run_many(MOTOR, K, network, chance)


def table(whole: bool) -> None:
    """One row in one convention, or all 22 on two processes, which takes minutes."""
    if not whole:
        took = timeit.timeit(lambda: table2_row(*TABLE_2[5], Units.PUBLISHED), number=1)
        print(f"Table 2, one row by every method: {took:.1f} s; all of it: --whole-table")
        return
    took = timeit.timeit(table2, number=1)
    print(f"Table 2, 11 rows by every method in 2 conventions, on two processes: {took:.1f} s")


if __name__ == "__main__":
    main()
