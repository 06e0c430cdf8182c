"""The rows of runs in simulated time beside the truth that taps on the segment and on the drives have taken.

One line for each plan of :mod:`tests.truth.plans`; ends with status 1 if a plan does not hold what is asked.

    wrong    rows that are marked certain and do not tell what happened
    unsure   rows that are marked uncertain; last: the last of them came so many cycles after a step of the
             drive's clock; far: so many came with no step before them
    no row   planned cycles and SYNCs without a row
    broken   instants of sampling that are further off than their row says
"""

import argparse
import sys
from collections.abc import Sequence

from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock
from tests.truth.plans import PLANS
from tests.truth.rows import LATE, LOST, MISSED, STALE
from tests.truth.runner import Outcome, run_plan

CYCLES = 520_000
"""Of all plans together, an axis' cycles each counted."""
HEAD = (
    f"{'plan':32} {'rows':>7} {'lost':>6} {'late':>6} {'stale':>6} {'missed':>6} | {'wrong':>6} {'unsure':>6}"
    f" {'last':>4} {'far':>5} {'no row':>6} | {'delay error us':>21} {'bound':>6} | {'SYNC bursts':>11}"
)


def main() -> None:
    """Print a table."""
    options = _options()
    plans = [plan for plan in PLANS if not options.plan or plan.name in options.plan]
    if len(plans) < len(options.plan):
        sys.exit(f"plans: {', '.join(plan.name for plan in PLANS)}")
    clock = MonotonicClock()
    until = Instant(clock.now() + round(options.seconds * NS_PER_S)) if options.seconds else None
    each = options.cycles // sum(plan.axes for plan in plans)
    print(f"{HEAD}\n{'':80} | {'':32} | {'p50':>6} {'p99':>7} {'max':>6} {'broken':>6} | {'handed':>6} bus")
    outcomes: list[Outcome] = []
    for plan in plans:
        if until is not None and clock.now() >= until:
            print(f"{len(plans) - len(outcomes)} plans were not run in {options.seconds} s")
            break
        outcomes.append(run_plan(plan, each))
        _print(outcomes[-1])
        for example in outcomes[-1].readings.examples[: options.show]:
            print(f"{'':32} {example}")
    sys.exit(_conclusion(outcomes))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cycles", type=int, default=CYCLES, help="of all plans together")
    parser.add_argument("--plan", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument("--seconds", type=float, default=0.0, help="begin no plan after so long")
    parser.add_argument("--show", type=int, default=0, help="so many of the wrong rows of each plan")
    return parser.parse_args()


def _print(outcome: Outcome) -> None:
    name, found = outcome.plan.name, outcome.readings
    if outcome.skipped:
        print(f"{name:32} skipped: {outcome.skipped}")
        return
    fates = " ".join(f"{found.fates[fate]:6}" for fate in (LOST, LATE, STALE, MISSED))
    p50, p99, most = (found.delay_error_us(percentile) for percentile in (50, 99, 100))
    told = f"{found.wrong:6} {found.uncertain:6} {found.uncertain_last:4} {found.uncertain_far:5}"
    delays = f"{p50:6.1f} {p99:7.1f} {most:6.0f} {found.bound_broken:6}"
    print(
        f"{name:32} {found.rows:7} {fates} | {told} {found.unaccounted:6} | {delays}"
        f" | {outcome.bursts_handed:6} {outcome.bursts_on_bus:3}"
    )
    if outcome.plan.commands:
        _print_commands(outcome)
    _print_broken(outcome)


def _print_commands(outcome: Outcome) -> None:
    found = outcome.commands
    least, most = found.told_loss_percent
    delays = ", ".join(
        f"{label} {told:.0f} ({true:.0f})"
        for label, percentile in (("p50", 50), ("p99", 99), ("max", 100))
        for told, true in [found.delay_us(percentile)]
    )
    print(
        f"{'':32} commands told (true): lost {least:.1f} to {most:.1f} ({found.true_loss_percent:.1f}) %,"
        f" delay us {delays}; {found.wrong} wrong, {found.outside} outside of their interval"
    )


def _print_broken(outcome: Outcome) -> None:
    kinds = ", ".join(f"{kind} {count}" for kind, count in outcome.readings.misjudged.most_common())
    if kinds:
        print(f"{'':32} {kinds}")
    if outcome.ended_by:
        print(f"{'':32} ended by: {outcome.ended_by}")


def _conclusion(outcomes: Sequence[Outcome]) -> int:
    run = [outcome for outcome in outcomes if not outcome.skipped]
    rows = sum(outcome.readings.rows for outcome in run)
    wrong = sum(outcome.readings.wrong for outcome in run)
    unsure = sum(outcome.readings.uncertain for outcome in run)
    broken = [outcome for outcome in run if outcome.broken()]
    print(f"\n{rows} rows of {len(run)} plans: {wrong} misjudged, {unsure} uncertain")
    for outcome in broken:
        print(f"  not held: {outcome.plan.name}: {'; '.join(outcome.broken())}")
    return 1 if broken else 0


if __name__ == "__main__":
    main()
