"""A review as a report in one file: Markdown, or HTML with its pictures in it."""

import base64
import html
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from servobench.drivers.errors import BadInput
from servobench.drivers.printable import printable
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.written_file import write_file
from servobench.hil.recorded.judgement import Judged
from servobench.hil.reviewing.html_page import html_page, html_table
from servobench.hil.rows.events import read_events
from servobench.hil.rows.run_files import EVENTS_FILE
from servobench.hil.verdict.summary_text import certificate_rows, limit_rows, summary_lines
from servobench.hil.verdict.verdict import LimitResult, VerdictKind, verdict_title

SUFFIXES: Final = (".html", ".md")
_EVENTS_MAX: Final = 200
"""A report is read; events.jsonl has all of them."""
_CLASSES: Final = {LimitResult.KEPT.value: "kept", LimitResult.BROKEN.value: "broken"}
Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Title, heads, rows."""


def write_report(judged: Judged, path: Path) -> None:
    """Raises BadInput for a path that ends otherwise, or cannot be written to."""
    if path.suffix not in SUFFIXES:
        raise BadInput("--report", "", str(path), f"a file that ends in {' or '.join(SUFFIXES)}")
    write_file("--report", path, _html(judged) if path.suffix == ".html" else _markdown(judged))


def _tables(judged: Judged) -> Iterator[Table]:
    summary = judged.summary
    yield (
        "Requirements",
        ("requirement", "value", "at most", "", "worst"),
        list(limit_rows(summary.verdict.limits)),
    )
    if summary.verdict.findings:
        findings = [(finding.outcome.value, finding.text) for finding in summary.verdict.findings]
        yield "Findings", ("", ""), findings
    if certified := certificate_rows(summary.certificates):
        yield "Certificate", ("", "certified", "seen"), certified
    yield "Figures", ("", ""), list(_figures(judged))
    yield "Run", ("", ""), list(_origin(judged))
    yield "Warnings and errors", ("s", "", ""), list(_events(judged.run.folder / EVENTS_FILE))


def _figures(judged: Judged) -> Iterator[tuple[str, str]]:
    summary, axes = judged.summary, len(judged.run.axes)
    yield "Cycles", f"{summary.cycles} of {judged.run.cycles_planned} planned, {axes} axes"
    yield from summary_lines(summary, axes).items()


def _origin(judged: Judged) -> Iterator[tuple[str, str]]:
    metadata = judged.run.metadata
    yield "folder", str(judged.run.folder)
    yield "seal", judged.run.seal
    yield "judged by", judged.against
    for key in ("bench", "bus", "seed", "time", "servobench", "commit"):
        yield key, metadata.get(key, "-") or "-"
    for axis, drive in json.loads(metadata.get("drives", "{}")).items():
        yield f"drive of {axis}", drive
    host = json.loads(metadata.get("host", "{}"))
    yield "host", ", ".join(f"{key} {value}" for key, value in host.items())


def _events(path: Path) -> Iterator[tuple[str, str, str]]:
    """Return the last events graver than a note."""
    rows = [
        (f"{event['at_ns'] / NS_PER_S:.6f}", str(event["level"]), printable(str(event["text"])))
        for event in read_events(path)
        if event.get("level") in ("WARN", "ERROR", "CRITICAL") and "text" in event
    ]
    yield from rows[-_EVENTS_MAX:]


def _pictures(judged: Judged) -> Iterator[tuple[str, str]]:
    from servobench.hil.recorded.paper import histogram_figure, paper_figure, svg_text

    yield "Speed, error, torque and delay; dashed: limits", svg_text(paper_figure(judged.signals))
    yield "Delays of the readings", svg_text(histogram_figure(judged.signals))


def _html(judged: Judged) -> str:
    verdict, name = judged.summary.verdict, judged.run.config.bench.name
    fair = verdict.outcome in (VerdictKind.PASSED, VerdictKind.NOTHING_ASKED)
    parts = [f"<h1>{html.escape(name)}</h1>"]
    parts.append(f"<p class='verdict{' passed' if fair else ''}'>{html.escape(verdict_title(verdict))}</p>")
    for title, heads, rows in _tables(judged):
        if rows:
            parts.append(f"<h2>{title}</h2>" + html_table(heads, rows, classes=_CLASSES))
        if title == "Requirements":
            parts += [
                f"<figure>{svg}<figcaption>{words}</figcaption></figure>" for words, svg in _pictures(judged)
            ]
    return html_page(name, parts)


def _markdown(judged: Judged) -> str:
    parts = [f"# {judged.run.config.bench.name}: {verdict_title(judged.summary.verdict)}"]
    for title, heads, rows in _tables(judged):
        if rows:
            lines = [f"| {' | '.join(heads)} |", "|" + ":--|" * len(heads)]
            lines += [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]
            parts.append(f"## {title}\n\n" + "\n".join(lines))
        if title == "Requirements":
            for words, svg in _pictures(judged):
                data = base64.b64encode(svg.encode()).decode()
                parts.append(f"![{words}](data:image/svg+xml;base64,{data})")
    return "\n\n".join(parts) + "\n"
