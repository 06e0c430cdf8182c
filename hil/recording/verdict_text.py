"""The verdict of a run as a page of Markdown."""

from hil.figures.summary import Check, Percentiles, Summary, metric_title
from hil.figures.timing_text import timing_lines
from hil.recording.recording_plan import RecordingPlan


def verdict_markdown(plan: RecordingPlan, summary: Summary | None) -> str:
    """What the reader of a recording sees first; without a summary the run still goes on."""
    if summary is None:
        return f"# {plan.name} · running\n\n{_notes(plan)}\n"
    verdict = summary.verdict
    parts = [f"# {plan.name} · {verdict_word(summary)}"]
    if verdict.reason:
        parts.append(f"**{verdict.reason}**")
    if verdict.limits:
        parts.append(
            "\n".join(["| limit | value | at most | |", "|:--|--:|--:|:--|", *map(_limit, verdict.limits)])
        )
    parts.append("\n".join(["| figure | value |", "|:--|:--|", *_figures(plan, summary)]))
    parts.append(_notes(plan))
    return "\n\n".join(parts) + "\n"


def verdict_word(summary: Summary) -> str:
    """PASS, FAIL or CUT SHORT."""
    verdict = summary.verdict
    return "PASS" if verdict.passed else "FAIL" if verdict.completed else "CUT SHORT"


def _limit(check: Check) -> str:
    value = "none" if check.value is None else f"{check.value:.4g}"
    result = "kept" if check.passed else "**broken**"
    return f"| {metric_title(check.metric)} | {value} | {check.limit:g} | {result} |"


def _figures(plan: RecordingPlan, summary: Summary) -> list[str]:
    lost = summary.dropouts
    readings = summary.cycles * len(plan.review.axes)
    share = 100.0 * lost.total / readings if readings else 0.0
    return [
        f"| delay p50 / p99 / max | {_times(summary.delay_us)} |",
        f"| dropouts | {lost.total} of {readings} ({share:.1f} %): "
        f"{lost.lost} lost, {lost.late} late, {lost.stale} stale, {lost.missed} missed |",
        f"| wake-up lateness p50 / p99 / max | {_times(summary.lateness_us)} |",
        *(f"| {title} | {line} |" for title, line in timing_lines(summary.timing).items()),
        f"| bus load | {_measured(summary.bus_load_percent)} % |",
        f"| times real time | {_measured(summary.realtime_factor)} |",
        *_load(summary),
        *(f"| recording | {fault} |" for fault in summary.recording_faults),
    ]


def _measured(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


def _load(summary: Summary) -> list[str]:
    """What the load machine was asked for and measured, step by step."""
    found = summary.load_machine
    if found is None:
        return []
    rows = []
    for step in found["steps"]:
        measured = "none" if step["measured_nm"] is None else f"{step['measured_nm']:.3g} N m"
        rows.append(f"| load asked, measured | {step['asked_nm']:g} N m, {measured} |")
    return [*rows, f"| load machine | {found['identity']}: {found['readings']} readings |"]


def _times(times: Percentiles) -> str:
    values = (times.p50, times.p99, times.max)
    return " / ".join("none" if value is None else f"{value:.0f}" for value in values) + " us"


def _notes(plan: RecordingPlan) -> str:
    notes = {"bus": plan.bus, "seed": str(plan.seed), **plan.notes}
    return " · ".join(f"{key} `{value}`" for key, value in notes.items())
