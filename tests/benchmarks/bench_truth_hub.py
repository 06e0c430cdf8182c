"""The rows of ``hil run`` on a hub, drives in another process, beside what a third, passive client heard.

Half an hour: ``python -m tests.benchmarks.bench_truth_hub --axes 1 --commands nowhere --cycles 1800000``.
At a further client's SYNCs: ``--jitter-us 0``, as on time as a process can be, or later by up to so much.
Ends with status 1 if something certain is wrong.
"""

import argparse
import sys
import tempfile
from itertools import product
from pathlib import Path

from tests.truth.hub_run import HubOutcome, run_beside_a_listener
from tests.truth.plans import COMMANDS_LATE, Plan
from tests.truth.process_watch import Holding, watching
from tests.truth.rows import LATE, LOST, MISSED, STALE, USED
from tests.truth.stalls import Stalls

CYCLES = 20_000
PERIODS_US = {1: 1000, 3: 2000}
"""The event PDOs that tell how a set-point arrived leave no room for three axes at 1 kHz."""
SIDES = ("nowhere", "host", "drive")
"""Before the echo, or behind it."""


def main() -> None:
    """Print some lines for each number of axes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--axes", type=int, choices=(1, 3), action="append", help="both, if left out")
    parser.add_argument("--cycles", type=int, default=CYCLES)
    parser.add_argument(
        "--commands", choices=SIDES, action="append", help="where they are lost and late; each, if left out"
    )
    parser.add_argument("--stalls", type=int, metavar="SEED", help="let the processes stand still at times")
    parser.add_argument("--longest-ms", type=float, default=15.0, help="for how long at most")
    parser.add_argument(
        "--jitter-us", type=int, action="append", help="at another node's SYNCs, so late at most"
    )
    options = parser.parse_args()
    stalls = None if options.stalls is None else Stalls(options.stalls, longest_ms=options.longest_ms)
    wrong = False
    for axes, side, jitter_us in product(
        options.axes or (1, 3), options.commands or SIDES, options.jitter_us or (None,)
    ):
        at_host = COMMANDS_LATE if side == "host" else ""
        at_drive = COMMANDS_LATE if side == "drive" else ""
        at_syncs = "" if jitter_us is None else f", at another's SYNCs, 0 to {jitter_us} us late"
        plan = Plan(
            f"{axes} axes, commands lost and late: {side}{at_syncs}",
            at_host,
            axes=axes,
            period_us=PERIODS_US[axes],
            commands=jitter_us is None,
            sync="own" if jitter_us is None else "foreign",
            producer_period_us=PERIODS_US[axes],
            producer_jitter_us=jitter_us or 0,
        )
        with tempfile.TemporaryDirectory() as scratch:
            with watching() as holdings:
                found = run_beside_a_listener(plan, options.cycles, Path(scratch), at_drive, stalls)
            _print(plan, found)
            _print_holdings(holdings)
        readings = found.readings
        wrong |= bool(readings.wrong or readings.bound_broken or readings.unaccounted or found.commands.wrong)
        wrong |= bool(readings.false_losses and not at_host and not at_drive)
    sys.exit(wrong)


def _print(plan: Plan, found: HubOutcome) -> None:
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
    print(f"{plan.name}: {readings.rows} rows, hil run ended with {found.status}: {fates}")
    if found.status:
        print(f"  {found.said.strip().splitlines()[-1]}")
    print(
        f"  misjudged {readings.wrong} ({kinds}); uncertain {readings.uncertain};"
        f" readings told lost that came {readings.false_losses}"
    )
    for example in readings.examples:
        print(f"    {example}")
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
    commands = found.commands
    least, most = commands.told_loss_percent
    delays = ", ".join(
        f"{label} {told:.0f} ({true:.0f})"
        for label, percentile in (("p50", 50), ("p99", 99), ("max", 100))
        for told, true in [commands.delay_us(percentile)]
    )
    print(
        f"  {commands.handed} commands, told (true): lost {least:.1f} to {most:.1f}"
        f" ({commands.true_loss_percent:.1f}) %, delay us {delays}"
    )
    print(f"  of them {commands.wrong} wrong, {commands.outside} outside of their interval")
    for example in commands.examples:
        print(f"    {example}")


def _print_holdings(holdings: list[Holding]) -> None:
    print("  resident memory in MB, descriptors: settled after a minute, most, last")
    for held in holdings:
        columns = [
            f"{kilobytes / 1e3:.0f}, {open_}" for kilobytes, open_ in (held.settled, held.most, held.last)
        ]
        print(f"    {held.name}: {'; '.join(columns)}")


if __name__ == "__main__":
    main()
