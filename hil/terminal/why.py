"""``hil why``: from a run that did not pass to the guilty cycles and frames."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.terminal.options import JsonOption, RunArgument, UnsealedOption, flag, valued
from servobench.hil.terminal.output import echo, note_seal, put

if TYPE_CHECKING:
    from servobench.hil.recorded.explanation import Explanation, GuiltyPlace
    from servobench.hil.reviewing.trace.trace_entry import TraceEntry
    from servobench.hil.verdict.summary import Summary

_CLOSE: Final = 2
"""Cycles of each axis that are shown before and behind the guilty ones; --all shows all."""
_END: Final = 6
"""Cycles of the beginning of a long stretch, and of its end."""
_FRAMES_NS: Final = 3 * NS_PER_MS // 2
"""About the beginning of a place, that are shown; --all shows all."""
_SEEN: Final = 3
"""Lines of what was seen, of each place, at the end of a run."""
_NOTHING_SEEN: Final = "nothing was injected or seen within, nor for 0.5 s before"
_HEAD: Final = (
    "   axis        cycle         due s  reading   delay us  asked r/min    r/min  command N m  command"
)
_CYCLIC: Final = ("pdo", "sync")


def why(
    run: RunArgument,
    against: Annotated[
        Path | None,
        valued(
            "--against",
            "REQUIREMENTS.toml",
            "A table \\[verdict] as in a bench file; the run's own if absent.",
        ),
    ] = None,
    everything: Annotated[bool, flag("--all", "Each cycle and frame of 50 ms before and behind.")] = False,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Say why a recorded run did not pass: for each broken limit, fault or burst of dropouts the guilty
    cycles, what was injected or seen just before, the frames around, and the command that opens the viewer.

    Exit status: see hil docs exit-status; 2 for an incomplete recording.

    Examples:
      hil why runs/monday
    """
    from servobench.hil.recorded.explanation import explain
    from servobench.hil.recorded.recorded_run import open_run
    from servobench.hil.verdict.verdict import verdict_title

    opened = open_run(run, unsealed=unsealed, windows=True)
    note_seal(run, opened.seal)
    summary = opened.summary
    if against is not None:
        from servobench.hil.recorded.judgement import judge_run  # which reads all that there is of each cycle

        summary = judge_run(opened, against).summary
    told = explain(opened, summary)
    verdict = summary.verdict
    figures: dict[str, Any] = {
        "verdict": verdict.outcome,
        "exit_status": verdict.exit_status,
        "places": [place.as_json(told.zero_ns) for place in told.places],
        "elsewhere": list(told.elsewhere),
        "more_places": told.more,
        "notes": list(told.notes),
        "seal": opened.seal,
    }
    put(figures, as_json, lambda _: _print(verdict_title(verdict), told, opened.folder, everything))
    raise typer.Exit(verdict.exit_status)


def brief_lines(summary: "Summary") -> Iterator[str]:
    """For the end of a run that did not pass: a line for each place, and the command that shows it."""
    if summary.verdict.passed or not summary.verdict.findings or not summary.recording:
        return
    from servobench.hil.recorded.explanation import brief  # pyarrow, which a run that passed does without

    folder = Path(summary.recording)
    told = brief(summary, folder)
    for place in told.places:
        yield f"Why        at {_second(place.begin_ns)} s  {'; '.join(place.told)}"
        yield from (f"           seen: {line}" for line in place.before[-_SEEN:])
    yield f"Why        hil why {folder} shows the guilty cycles and frames"


def _print(title: str, told: "Explanation", folder: Path, everything: bool) -> None:
    echo(title)
    for number, place in enumerate(told.places, 1):
        echo(f"\n{number}. {_stretch(place)}")
        for line in place.told:
            echo(f"   {line}")
        echo("   seen just before and within:" if place.before else f"   {_NOTHING_SEEN}")
        for line in place.before:
            echo(f"     {line}")
        _print_cycles(place, everything)
        _print_frames(place, told.zero_ns, everything)
        begin_s, end_s = place.begin_ns / NS_PER_S, place.end_ns / NS_PER_S
        echo(f"   hil view {folder} --at {begin_s:.3f} --span {max(0.1, 2 * (end_s - begin_s)):.3g}")
        echo(f"   hil trace {folder} --from {begin_s - 0.05:.3f} --to {end_s + 0.05:.3f}")
    if told.more:
        echo(f"\n{told.more} more places; hil review shows the worst of each limit")
    if told.elsewhere:
        echo("\nOf the whole run, or at an instant that is not known:")
    for line in [*told.elsewhere, *(f"note: {note}" for note in told.notes)]:
        echo(f"   {line}")
    if not told.places and not told.elsewhere:
        echo("Nothing went wrong: no limit is broken, and no reading was lost three times in a row.")


def _stretch(place: "GuiltyPlace") -> str:
    begin, end = _second(place.begin_ns), _second(place.end_ns)
    return f"at {begin} s" if begin == end else f"from {begin} to {end} s"


def _second(at_ns: int) -> str:
    return f"{at_ns / NS_PER_S:.6f}".rstrip("0").ljust(5, "0") if at_ns % NS_PER_S else f"{at_ns // NS_PER_S}"


def _print_cycles(place: "GuiltyPlace", everything: bool) -> None:
    """Of the guilty axes; of a longer stretch its beginning and its end."""
    named = [each for each in place.cycles if not place.axes or each["axis"] in place.axes]
    if named:
        echo(_HEAD)
    for axis in dict.fromkeys(each["axis"] for each in named):
        cycles = [each for each in named if each["axis"] == axis]
        before = 0
        for each in cycles if everything else _near(cycles, place):
            if before and each["sequence"] > before + 1:
                echo("   ...")
            before = each["sequence"]
            echo(
                f" {'>' if place.is_guilty(_due_ns(each)) else ' '} {axis:<8} {before:>8} "
                f"{each['due_s']:>13.6f}  {each['fate']:<7} {_number(each['delay_us'], 0):>10} "
                f"{_rpm(each['reference_rad_s']):>12} {_rpm(each['velocity_rad_s']):>8} "
                f"{_number(each['command_torque_nm'], 3):>12}  {each['command'] or '-'}"
            )


def _near(cycles: Sequence[dict[str, Any]], place: "GuiltyPlace") -> list[dict[str, Any]]:
    """Of each stretch its beginning and its end, or the cycle next to it, and a few before and behind."""
    near = set[int]()
    for begin_ns, end_ns in place.spans:
        inside = [number for number, each in enumerate(cycles) if begin_ns <= _due_ns(each) <= end_ns]
        if not inside:
            distances = [abs(_due_ns(each) - begin_ns) for each in cycles]
            inside = [distances.index(min(distances))]
        guilty = inside if len(inside) <= 2 * _END else [*inside[:_END], *inside[-_END:]]
        first, last = inside[0], inside[-1]
        near |= {*guilty, *range(first - _CLOSE, first), *range(last + 1, last + 1 + _CLOSE)}
    return [each for number, each in enumerate(cycles) if number in near]


def _due_ns(cycle: dict[str, Any]) -> int:
    return round(float(cycle["due_s"]) * NS_PER_S)


def _print_frames(place: "GuiltyPlace", zero_ns: int, everything: bool) -> None:
    from servobench.hil.terminal.trace import line_of

    shown = [each for each in place.frames if everything or _is_telling(each, place, zero_ns)]
    if shown:
        kept = (
            "" if len(shown) == len(place.frames) else f", {len(shown)} of {len(place.frames)} (--all: each)"
        )
        echo(f"   frames of 50 ms before and behind{kept}:")
    for entry in shown:
        echo(f"   {line_of(entry, zero_ns)}")


def _is_telling(entry: "TraceEntry", place: "GuiltyPlace", zero_ns: int) -> bool:
    """It comes about the beginning, or is none of those that come in each cycle."""
    at_ns = (entry.at_ns or 0) - zero_ns
    return entry.kind not in _CYCLIC or any(abs(at_ns - begin) <= _FRAMES_NS for begin, _ in place.spans)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _rpm(value: float | None) -> str:
    return "-" if value is None else f"{value * RPM_PER_RAD_S:.1f}"
