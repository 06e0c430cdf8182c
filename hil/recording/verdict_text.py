"""The verdict of a run as a page of Markdown."""

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from textwrap import wrap
from typing import Final

from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import FIRST_CYCLE_EPOCH
from servobench.hil.verdict.figures import Figures
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.summary_text import (
    certificate_rows,
    computing_note,
    figure_lines,
    limit_rows,
    summary_lines,
)
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
        parts.append(_limits("value", verdict.limits))
    if certified := certificate_rows(summary.certificates):
        head = ["| certificate | certified | seen |", "|:--|--:|--:|"]
        parts.append("\n".join([*head, *(f"| {' | '.join(row)} |" for row in certified)]))
    lines = _rows(summary_lines(summary, len(plan.review.axes)))
    lacks = [row for fault in summary.recording_faults for row in _in_rows("Recording lacks", fault)]
    parts.append("\n".join(["| figure | value |", "|:--|:--|", *lines, *lacks]))
    return "\n\n".join(parts) + "\n"


def running_markdown(
    plan: RecordingPlan, figures: Figures, checks: Sequence[Check], metadata: Mapping[str, str]
) -> str:
    """While the run goes on: the figures so far, held against the limits."""
    lines = {"Cycles": str(figures.cycles), **figure_lines(figures, len(plan.review.axes))}
    table = "\n".join(["| figure so far | value |", "|:--|:--|", *_rows(lines)])
    broken = any(check.result is LimitResult.BROKEN for check in checks)
    parts = [f"# {plan.name} · running{', A LIMIT IS BROKEN' if broken else ''}", _origin(plan, metadata)]
    parts += [_limits("so far", checks)] if checks else []
    return "\n\n".join([*parts, table]) + "\n"


def broken_texts(checks: Iterable[Check]) -> dict[str, str]:
    """Return a line for each limit that is broken, by its name."""
    broken = [check for check in checks if check.result is LimitResult.BROKEN]
    return {
        check.metric: f"limit broken: {title}: {value}, at most {limit} {where}".rstrip()
        for check, (title, value, limit, _, where) in zip(broken, limit_rows(broken), strict=True)
    }


def _limits(value: str, checks: Sequence[Check]) -> str:
    head = [f"| limit | {value} | at most | | worst |", "|:--|--:|--:|:--|:--|"]
    return "\n".join([*head, *map(_limit, limit_rows(checks))])


def _limit(row: tuple[str, str, str, str, str]) -> str:
    title, value, limit, result, where = row
    shown = "**BROKEN**" if result == LimitResult.BROKEN else result
    return f"| {title} | {value} | {limit} | {shown} | {where} |"


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


def _rows(lines: Mapping[str, str]) -> list[str]:
    return [row for title, text in lines.items() for row in _in_rows(title, text)]


def _in_rows(title: str, text: str) -> list[str]:
    """A cell shows one line alone."""
    lines = wrap(text.replace("|", "/"), _CELL_COLUMNS) or [""]
    return [f"| {title if place == 0 else ''} | {line} |" for place, line in enumerate(lines)]
