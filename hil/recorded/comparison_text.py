"""A comparison of runs in lines for a reader."""

from collections.abc import Iterator, Mapping, Sequence

from drivers.timebase import NS_PER_S
from hil.recorded.comparison import Against, Regression

_COLUMNS_MAX = 8
"""Of a divergence: more columns say no more."""


def comparison_lines(compared: Sequence[Against], judged: Mapping[str, Sequence[Regression]]) -> list[str]:
    """Figures side by side, then each run beside the first."""
    lines = [f"{number}  {each.run.title()}" for number, each in enumerate(compared)]
    lines += ["", f"{'':28}" + "".join(f"{number:>12}" for number in range(len(compared)))]
    for name in compared[0].figures:
        values = [each.figures[name] for each in compared]
        lines.append(f"{name:28}" + "".join(f"{_number(value):>12}" for value in values))
    for number, each in enumerate(compared[1:], start=1):
        lines += ["", f"{number} beside 0: {each.cycles_of_both} cycles of both"]
        lines += _apart(each)
        lines += [_judged(one) for one in judged.get(str(each.run.folder), ())]
    return lines


def _apart(each: Against) -> Iterator[str]:
    divergence = each.divergence
    if divergence is None:
        yield "  every cycle of both is the same"
        return
    more = len(divergence.columns) - _COLUMNS_MAX
    named = ", ".join(divergence.columns[:_COLUMNS_MAX]) + (f" and {more} more" if more > 0 else "")
    at_s = divergence.at_ns / NS_PER_S
    yield f"  first divergence: {divergence.axis}, cycle {divergence.cycle} at {at_s:.6f} s, in {named}"
    for axis, signals in each.differences.items():
        for signal, one in signals.items():
            if one.count and one.largest:
                at = "" if one.at_ns is None else f" at {one.at_ns / NS_PER_S:.3f} s"
                sizes = f"rms {_number(one.rms):>10}  largest {_number(one.largest):>10}"
                yield f"  {axis} {signal:20} {sizes}{at}"


def _judged(one: Regression) -> str:
    result = {True: "within", False: "EXCEEDED", None: "not measured in both"}[one.kept]
    return (
        f"  {one.name:28} {_number(one.value):>10}, baseline {_number(one.baseline):>10} "
        f"+ {one.tolerance:g}: {result}"
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
