"""The rows of ``hil run`` on a hub, drives in another process, beside what a third, passive client heard."""

import argparse
import tempfile
from pathlib import Path

from tests.truth.hub_run import HubOutcome, run_beside_a_listener
from tests.truth.rows import LATE, LOST, MISSED, STALE, USED

CYCLES = 20_000


def main() -> None:
    """Print some lines for each number of axes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--axes", type=int, choices=(1, 3), action="append", help="both, if left out")
    parser.add_argument("--cycles", type=int, default=CYCLES)
    options = parser.parse_args()
    for axes in options.axes or (1, 3):
        with tempfile.TemporaryDirectory() as scratch:
            _print(axes, run_beside_a_listener(axes, options.cycles, Path(scratch)))


def _print(axes: int, found: HubOutcome) -> None:
    readings, spacings = found.readings, found.spacings
    fates = ", ".join(
        f"{readings.fates[fate]} {name}"
        for fate, name in (
            (USED, "used"),
            (LOST, "lost"),
            (LATE, "late"),
            (STALE, "stale"),
            (MISSED, "missed"),
        )
    )
    kinds = ", ".join(f"{kind}: {count}" for kind, count in readings.misjudged.most_common()) or "none"
    p50, p99, most = found.delays_us
    errors = [readings.delay_error_us(percentile) for percentile in (50, 99, 100)]
    print(f"{axes} axes, {readings.rows} rows, hil run ended with {found.status}: {fates}")
    print(f"  misjudged {readings.wrong} ({kinds}); uncertain {readings.uncertain}")
    print(
        f"  delays told, us: p50 {p50:.0f}, p99 {p99:.0f}, max {most:.0f}; negative {found.negative_delays}"
    )
    print(f"  delay error, us: p50 {errors[0]:.1f}, p99 {errors[1]:.1f}, max {errors[2]:.1f}")
    print(f"  sampled_at_error_ns broken {readings.bound_broken}; wrong SYNC echoes {readings.echo_wrong}")
    print(
        f"  SYNCs closer than half a period: {spacings.handed} at hand-over, {spacings.on_bus} on the bus,"
        f" of those {spacings.held_up} because the first was held up; unaccounted {readings.unaccounted}"
    )
    print(f"  SYNCs that ended on the bus before they were handed over: {spacings.too_early}")


if __name__ == "__main__":
    main()
