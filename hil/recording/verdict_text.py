"""The verdict of a run as a page of Markdown."""

from hil.rows.recording_plan import RecordingPlan
from hil.verdict.summary import Percentiles, Summary, metric_title
from hil.verdict.summary_text import certificate_lines, timing_lines
from hil.verdict.verdict import Check, LimitResult, verdict_title


def verdict_markdown(plan: RecordingPlan, summary: Summary | None) -> str:
    """What the reader of a recording sees first; without a summary the run still goes on."""
    if summary is None:
        return f"# {plan.name} · running\n\n{_notes(plan)}\n"
    verdict = summary.verdict
    parts = [f"# {plan.name} · {verdict_title(verdict)}"]
    if verdict.findings:
        parts.append("\n".join(f"- {finding.outcome}: **{finding.text}**" for finding in verdict.findings))
    if verdict.limits:
        parts.append(
            "\n".join(["| limit | value | at most | |", "|:--|--:|--:|:--|", *map(_limit, verdict.limits)])
        )
    parts.append("\n".join(["| figure | value |", "|:--|:--|", *_figures(plan, summary)]))
    parts.append(_notes(plan))
    return "\n\n".join(parts) + "\n"


def _limit(check: Check) -> str:
    value = "none" if check.value is None else f"{check.value:.4g}"
    result = "**broken**" if check.result is LimitResult.BROKEN else check.result.value
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
        f"| computing time p50 / p99 / max | {_times(summary.compute_us)} |",
        *(f"| {title} | {line} |" for title, line in timing_lines(summary.timing).items()),
        *_swing(summary),
        *(f"| {title} | {line} |" for title, line in certificate_lines(summary.certificates).items()),
        f"| bus load | {_measured(summary.bus_load_percent, ' %')} |",
        f"| times real time | {_measured(summary.realtime_factor)} |",
        *_load(summary),
        *(f"| recording | {fault} |" for fault in summary.recording_faults),
    ]


def _swing(summary: Summary) -> list[str]:
    """How much the torque swings while nothing asks for it."""
    if summary.torque_rms_nm is None:
        return []
    return [f"| torque about its mean, rms | {summary.torque_rms_nm:.3g} N m |"]


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


def _measured(value: float | None, unit: str = "") -> str:
    return "not measured" if value is None else f"{value:.1f}{unit}"


def _times(times: Percentiles) -> str:
    values = (times.p50, times.p99, times.max)
    return " / ".join("none" if value is None else f"{value:.0f}" for value in values) + " us"


def _notes(plan: RecordingPlan) -> str:
    notes = {"bus": plan.bus, "seed": str(plan.seed), **plan.notes}
    return " · ".join(f"{key} `{value}`" for key, value in notes.items())
