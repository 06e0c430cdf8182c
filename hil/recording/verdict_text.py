"""The verdict of a run as a page of Markdown."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from textwrap import wrap
from typing import Final

from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import FIRST_CYCLE_EPOCH
from servobench.hil.verdict.figures import Figures, Percentiles
from servobench.hil.verdict.limits import metric_title
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.summary_text import certificate_rows, computing_note, loss_text, timing_lines
from servobench.hil.verdict.verdict import Check, LimitResult, verdict_title

_CELL_COLUMNS: Final = 52
"""So much a table at the right of a screen of 1920 shows beside the titles."""


def verdict_markdown(
    plan: RecordingPlan, summary: Summary | None, metadata: Mapping[str, str] | None = None
) -> str:
    """Return the text that the reader of a recording sees first; without a summary the run still goes on.

    ``metadata``: of the run, as far as it is known (:mod:`servobench.hil.recording.run_metadata`).
    """
    if summary is None:
        return f"# {plan.name} · running\n\n{_origin(plan, metadata or {})}\n"
    verdict = summary.verdict
    parts = [f"# {plan.name} · {verdict_title(verdict)}", _origin(plan, metadata or {})]
    remarks = [f"- {finding.outcome}: **{finding.text}**" for finding in verdict.findings]
    if slow := computing_note(summary, plan.review.period / NS_PER_US):
        remarks.append(f"- {slow}")
    if remarks:
        parts.append("\n".join(remarks))
    if verdict.limits:
        head = ["| limit | value | at most | | worst |", "|:--|--:|--:|:--|:--|"]
        parts.append("\n".join([*head, *map(_limit, verdict.limits)]))
    if certified := certificate_rows(summary.certificates):
        head = ["| certificate | certified | seen |", "|:--|--:|--:|"]
        parts.append("\n".join([*head, *(f"| {' | '.join(row)} |" for row in certified)]))
    parts.append("\n".join(["| figure | value |", "|:--|:--|", *_figures(plan, summary)]))
    return "\n\n".join(parts) + "\n"


def running_markdown(plan: RecordingPlan, figures: Figures, metadata: Mapping[str, str]) -> str:
    """While the run goes on: the figures so far."""
    lost, error, steps = figures.dropouts, figures.speed_error, figures.step_response
    shares = (
        ("cycles", str(figures.cycles)),
        ("delay of readings p50 / p99 / max", _times(figures.reading_delay_us)),
        ("delay to actuation p50 / p99 / max", _times(figures.action_delay_us)),
        ("lateness p50 / p99 / max", _times(figures.lateness_us)),
        ("dropouts", f"{lost.lost} lost, {lost.late} late, {lost.stale} stale, {lost.missed} missed"),
        ("lost in a row", loss_text(figures)),
        ("speed error, peak", _measured(error.peak_percent, " %")),
        ("overshoot", _measured(steps.overshoot_percent, " %")),
        ("settling", _measured(steps.settling_time_ms, " ms")),
    )
    rows = [f"| {title} | {value} |" for title, value in shares]
    head = ["| figure so far | value |", "|:--|:--|"]
    return (
        "\n\n".join([f"# {plan.name} · running", _origin(plan, metadata), "\n".join([*head, *rows])]) + "\n"
    )


def _limit(check: Check) -> str:
    value = "none" if check.value is None else f"{check.value:.4g}"
    result = "**BROKEN**" if check.result is LimitResult.BROKEN else check.result.value
    at = "" if check.at_ns is None else f" at {check.at_ns / NS_PER_S:.3f} s"
    return f"| {metric_title(check.metric)} | {value} | {check.limit:g} | {result} | {check.axis}{at} |"


def _origin(plan: RecordingPlan, metadata: Mapping[str, str]) -> str:
    """Who ran what, when, and with which version."""
    told = {"bus": plan.bus, **plan.notes, "seed": str(plan.seed)}
    for axis, drive in json.loads(metadata.get("drives", "{}")).items():
        told[f"drive of {axis}"] = drive
    if epoch := metadata.get(FIRST_CYCLE_EPOCH):
        real = metadata.get("time") == "real"
        began = datetime.fromtimestamp(int(epoch) / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        told["first cycle"] = began if real else "in simulated time"
    if host := json.loads(metadata.get("host", "{}")):
        told["host"] = f"{host['name']}, {host['system']}, Python {host['python']}"
    version = " ".join(filter(None, (metadata.get("servobench"), metadata.get("commit", "")[:12])))
    if version:
        told["servobench"] = version
    return " · ".join(f"{key} `{value}`" for key, value in told.items())


def _figures(plan: RecordingPlan, summary: Summary) -> list[str]:
    lost = summary.dropouts
    readings = summary.cycles * len(plan.review.axes)
    share = 100.0 * lost.total / readings if readings else 0.0
    return [
        f"| delay of readings p50 / p99 / max | {_times(summary.reading_delay_us)} |",
        f"| delay to actuation p50 / p99 / max | {_times(summary.action_delay_us)} |",
        f"| lost in a row | {loss_text(summary)} |",
        f"| dropouts | {lost.total} of {readings} ({share:.1f} %) |",
        f"| | {lost.lost} lost, {lost.late} late, {lost.stale} stale, {lost.missed} missed |",
        f"| wake-up lateness p50 / p99 / max | {_times(summary.lateness_us)} |",
        f"| computing time p50 / p99 / max | {_times(summary.compute_us)} |",
        *(row for title, line in timing_lines(summary.timing).items() for row in _in_rows(title, line)),
        *_swing(summary),
        f"| bus load | {_measured(summary.bus_load_percent, ' %')} |",
        f"| times real time | {_measured(summary.realtime_factor)} |",
        *_load(summary),
        *(row for fault in summary.recording_faults for row in _in_rows("recording", fault)),
    ]


def _in_rows(title: str, text: str) -> list[str]:
    """A cell shows one line alone."""
    lines = wrap(text.replace("|", "/"), _CELL_COLUMNS) or [""]
    return [f"| {title if place == 0 else ''} | {line} |" for place, line in enumerate(lines)]


def _swing(summary: Summary) -> list[str]:
    """How much the torque swings while nothing asks for it."""
    if summary.torque_rms_nm is None:
        return []
    return [f"| torque about its mean, rms | {summary.torque_rms_nm:.3g} N m |"]


def _load(summary: Summary) -> list[str]:
    """List the load machine's commands and measurements, step by step."""
    machine = summary.load_machine
    if machine is None:
        return []
    rows = []
    for step in machine["steps"]:
        measured = "none" if step["measured_nm"] is None else f"{step['measured_nm']:.3g} N m"
        rows.append(f"| load asked, measured | {step['asked_nm']:g} N m, {measured} |")
    return [*rows, f"| load machine | {machine['identity']}: {machine['readings']} readings |"]


def _measured(value: float | None, unit: str = "") -> str:
    return "not measured" if value is None else f"{value:.1f}{unit}"


def _times(times: Percentiles) -> str:
    values = (times.p50, times.p99, times.max)
    return " / ".join("none" if value is None else f"{value:.0f}" for value in values) + " us"
