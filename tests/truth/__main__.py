"""``python -m tests.truth``: drawn plans in simulated time, all that a run tells held against the taps.

    python -m tests.truth --seconds 300            as many plans as fit in, and a table
    python -m tests.truth --seconds 300 --shrink   the same, with what each failing plan needs to fail
    python -m tests.truth --seed 7                 one plan: what it is, the judgement, the first wrong rows
    python -m tests.truth --seed 7 --shrink        the fewest of its features that fail in the same way
    python -m tests.truth --seed 7 --only "loss"   the plan with these of its features alone

    wrong      certain rows that do not tell what happened
    broken     certain rows whose interval does not hold the instant of sampling
    unsure     rows that are marked uncertain, by what befell them (tests/truth/doubts.py)
    open       rows that nobody could decide from when SYNCs and readings came (tests/truth/oracle.py)
    explained  rows that no other way to place the readings explains (tests/truth/other_ways.py)
    commands   told lost and acted, or told acting and were lost; outside: acted outside of the interval told

Ends with status 1 if something certain is wrong.
"""

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.truth.doubts import CAUSES
from tests.truth.drawn import FEATURES, drawn_plan, shrunk
from tests.truth.drawn_bench import DrawnPlan
from tests.truth.drawn_run import CYCLES, Verdict, judged

FOREVER_S: Final = 1e9
EXAMPLES: Final = 8


def main() -> None:
    """One plan, or a campaign."""
    given = _options()
    without, only = _names(given.without), _names(given.only)
    if given.seed is None:
        sys.exit(_campaign(given))
    plan = drawn_plan(given.seed, without or (), only)
    if given.shrink:
        plan = _shrunk(judged(plan, given.cycles), given.cycles)[1]
    verdict = judged(plan, given.cycles)
    _print_one(verdict)
    sys.exit(bool(verdict.wrong))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.truth",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seconds", type=float, default=FOREVER_S, help="begin no plan after so long")
    parser.add_argument("--plans", type=int, default=1_000_000, help="at most so many")
    parser.add_argument("--first", type=int, default=1, help="the seed of the first plan; the others follow")
    parser.add_argument("--cycles", type=int, default=CYCLES, help="of each axis of a plan")
    parser.add_argument("--seed", type=int, help="of one plan to replay")
    parser.add_argument("--without", help="features to leave out, with commas between")
    parser.add_argument("--only", help="features to keep, with commas between")
    parser.add_argument("--shrink", action="store_true", help="leave out what is not needed to fail")
    return parser.parse_args()


def _names(text: str | None) -> list[str] | None:
    if text is None:
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in FEATURES]
    if unknown:
        sys.exit(f"no feature: {', '.join(unknown)}; features: {', '.join(FEATURES)}")
    return names


def _shrunk(verdict: Verdict, cycles: int) -> tuple[str, DrawnPlan]:
    """The first of the ways in which a plan fails, and what is left of the plan that fails so."""
    plan, way = verdict.plan, next(iter(verdict.wrong), "")
    return way, shrunk(plan, lambda fewer: way in judged(fewer, cycles).wrong) if way else plan


def _print_one(verdict: Verdict) -> None:
    plan, readings, commands = verdict.plan, verdict.readings, verdict.commands
    print(f"seed {plan.seed}")
    for name, words in zip(plan.features, plan.words, strict=True):
        print(f"  {name:26} {words}")
    print(f"  replay: {_replay(plan)}")
    print(
        f"{readings.rows} rows: {readings.wrong} wrong, {readings.bound_broken} bounds broken,"
        f" {readings.uncertain} unsure, of which {readings.uncertain_wrong} would be wrong"
    )
    print(
        f"{commands.handed} commands: {commands.lost} lost; told: {commands.told_acting} acting,"
        f" {commands.told_lost} lost; {commands.wrong} wrong, {commands.outside} outside of their interval"
    )
    for kind, count in verdict.wrong.items():
        print(f"  {count:6} {kind}")
    _print_doubts([verdict])
    for example in verdict.examples[:EXAMPLES]:
        print(f"  {example}")


def _replay(plan: DrawnPlan) -> str:
    return f'python -m tests.truth --seed {plan.seed} --only "{", ".join(plan.features)}"'


def _campaign(given: argparse.Namespace) -> int:
    clock = MonotonicClock()
    ends_at = clock.now() + given.seconds * NS_PER_S
    verdicts: list[Verdict] = []
    causes: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for seed in range(given.first, given.first + given.plans):
        if clock.now() >= ends_at:
            break
        verdict = judged(drawn_plan(seed), given.cycles)
        verdicts.append(verdict)
        if verdict.wrong:
            print(_in_a_line(verdict), flush=True)
            if given.shrink:
                way, plan = _shrunk(verdict, given.cycles)
                causes[way, *plan.features].append(seed)
    _print_totals(verdicts)
    _print_features(verdicts)
    _print_causes(causes)
    return int(any(verdict.wrong for verdict in verdicts))


def _print_causes(causes: Mapping[tuple[str, ...], Sequence[int]]) -> None:
    """The features that failing plans come down to, the commonest first, with their seeds."""
    for (way, *names), seeds in sorted(causes.items(), key=lambda cause: len(cause[1]), reverse=True):
        print(f"{len(seeds):4} {way:30} {', '.join(names)}: {', '.join(map(str, seeds[:6]))}")


def _in_a_line(verdict: Verdict) -> str:
    kinds = ", ".join(f"{kind} {count}" for kind, count in verdict.wrong.items())
    ended = f" ({verdict.ended_by[:100]})" if verdict.ended_by else ""
    return f"seed {verdict.plan.seed}, {verdict.readings.rows} rows: {kinds}{ended}"


def _print_totals(verdicts: Sequence[Verdict]) -> None:
    rows = sum(verdict.readings.rows for verdict in verdicts)
    commands = sum(verdict.commands.handed for verdict in verdicts)
    failed = [verdict.plan.seed for verdict in verdicts if verdict.wrong]
    kinds: Counter[str] = Counter()
    for verdict in verdicts:
        kinds.update(verdict.wrong)
    print(f"\n{len(verdicts)} plans, {rows} rows, {commands} commands; {len(failed)} plans fail")
    sums = {
        "rows wrong": sum(verdict.readings.wrong for verdict in verdicts),
        "bounds broken": kinds["bound broken"],
        "commands wrong": kinds["command's fate"],
        "commands outside": kinds["command outside"],
    }
    print(", ".join(f"{name} {count}" for name, count in sums.items()))
    print(f"all kinds: {', '.join(f'{kind} {count}' for kind, count in kinds.most_common()) or 'none'}")
    for name, those in _classes(verdicts):
        total = sum(verdict.readings.rows for verdict in those)
        unsure = sum(verdict.readings.uncertain for verdict in those)
        worst = sorted(those, key=_unsure_share, reverse=True)[:5]
        share = f"{100 * unsure / total:.2f} %" if total else "no row"
        seeds = ", ".join(f"{verdict.plan.seed} ({100 * _unsure_share(verdict):.0f} %)" for verdict in worst)
        print(f"unsure, {name}: {share} of {total} rows of {len(those)} plans; most: {seeds}")
    _print_doubts(verdicts)


def _print_doubts(verdicts: Sequence[Verdict]) -> None:
    """Rows in doubt by cause, and how many of them nobody could decide."""
    for name, those in _classes(verdicts):
        causes: Counter[tuple[str, bool]] = sum((verdict.doubts for verdict in those), Counter())
        if not causes or name.startswith("these"):
            continue
        rows = sum(verdict.readings.rows for verdict in those)
        undecidable = sum(verdict.undecidable for verdict in those)
        known = "" if those[0].plan.has_stamps else f", {100 * undecidable / rows:.2f} % are open"
        print(f"\nunsure, {name}: {causes.total()} of {rows} rows{known}")
        if not those[0].plan.has_stamps:
            alone = rows - sum(verdict.ambiguous for verdict in those)
            unsure = sum(verdict.unsure_unambiguous for verdict in those)
            print(
                f"  {alone} rows have one explanation; of those {100 * unsure / max(1, alone):.2f} % unsure"
            )
        for cause in CAUSES:
            if count := causes[cause, False] + causes[cause, True]:
                print(f"  {cause:34} {count:7} {100 * count / rows:6.2f} %, open {causes[cause, True]:7}")


def _unsure_share(verdict: Verdict) -> float:
    return verdict.readings.uncertain / max(1, verdict.readings.rows)


def _classes(verdicts: Sequence[Verdict]) -> Iterator[tuple[str, list[Verdict]]]:
    stamped = [verdict for verdict in verdicts if verdict.plan.has_stamps]
    yield "with stamps", stamped
    yield "with stamps, delays below two periods", [v for v in stamped if v.plan.delays_are_short]
    fine = [v for v in stamped if v.plan.delays_are_short and v.plan.stamps_are_fine]
    yield "these, stamps finer than a tenth of a period", fine
    without = [verdict for verdict in verdicts if not verdict.plan.has_stamps]
    yield "without, delays below two periods", [v for v in without if v.plan.delays_are_short]
    yield "without, longer delays", [v for v in without if not v.plan.delays_are_short]


def _print_features(verdicts: Sequence[Verdict]) -> None:
    """By how much likelier a plan fails that has a feature than one that does not."""
    print(
        f"\n{'feature':26} {'plans':>5} {'fail with':>10} {'without':>8} {'unsure with':>12} {'without':>8}"
    )
    lines = []
    for name in FEATURES:
        parts = [[v for v in verdicts if (name in v.plan.features) is has] for has in (True, False)]
        fails = [sum(bool(v.wrong) for v in part) / max(1, len(part)) for part in parts]
        unsure = [sum(map(_unsure_share, part)) / max(1, len(part)) for part in parts]
        lines.append((fails[0] - fails[1], name, len(parts[0]), fails, unsure))
    for _, name, count, fails, unsure in sorted(lines, reverse=True):
        print(
            f"{name:26} {count:5} {100 * fails[0]:8.0f} % {100 * fails[1]:6.0f} %"
            f" {100 * unsure[0]:10.1f} % {100 * unsure[1]:6.1f} %"
        )


if __name__ == "__main__":
    main()
