"""The review of a run or of a log as a report in one file: Markdown, or HTML with its pictures in it. That of
a log is worded for the terminal too."""

import base64
import html
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from servobench.drivers.errors import BadInput, printable
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.written_file import write_file
from servobench.hil.recorded.judgement import Judged
from servobench.hil.recorded.log_axis import AxisReview
from servobench.hil.recorded.log_review import LogReview
from servobench.hil.reviewing.html_page import html_page, html_table
from servobench.hil.rows.events import read_events
from servobench.hil.rows.run_files import EVENTS_FILE
from servobench.hil.verdict.metrics import metric_title
from servobench.hil.verdict.summary_text import certificate_rows, limit_rows, number, summary_lines
from servobench.hil.verdict.verdict import ExitStatus, LimitResult, VerdictKind, verdict_title

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
    yield "Warnings and errors", ("at, s", "", ""), list(_events(judged.run.folder / EVENTS_FILE))


def _figures(judged: Judged) -> Iterator[tuple[str, str]]:
    summary, axes = judged.summary, len(judged.run.axes)
    counted = f"{axes} {'axis' if axes == 1 else 'axes'}"
    yield "Cycles", f"{summary.cycles} of {judged.run.cycles_planned} planned, {counted}"
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


PDO_HEADS: Final = (
    "axis",
    "PDO",
    "frames",
    "SYNC",
    "due",
    "lost",
    "row",
    "late",
    "p50 us",
    "p99 us",
    "max us",
)
"""Frames in all; with which SYNCs; in how many cycles due, lost, in a row, after the next SYNC; delay."""
_LINES_MAX: Final = 200
"""Of a table of a page; --json has all."""


def sync_lines(review: LogReview) -> Iterator[str]:
    """Yield a line for each interface."""
    told = review.as_json()
    for name, sync in told["sync"].items():
        where = f"{name}: " if len(told["sync"]) > 1 else ""
        every = f"every {number(sync['period_us'])} us (bench: {sync['bench_period_us']})"
        off = f"at most {number(sync['jitter_us'])} us off"
        yield f"{where}{sync['syncs']} SYNCs {every}, {off}, {sync['missed']} missed"
    cycles, axes = told["cycles"], len(review.axes)
    yield f"figures and limits: {cycles} cycles{' of each axis' if axes > 1 else ''}, the drive enabled"


def pdo_rows(review: LogReview) -> Iterator[tuple[str, ...]]:
    """Yield the rows below :data:`PDO_HEADS`."""
    for axis in review.axes:
        told = axis.as_json()
        for pdo in told["pdos"]:
            every, delays = pdo["every_nth_sync"], pdo["delay_us"] or {}
            main = pdo["name"] in (told["reading"], told["command"])
            cyclic = every is not None
            yield (
                axis.name,
                f"{pdo['name']}{' *' if main else ''}",
                str(pdo["frames"]),
                "event" if every is None else "each" if every == 1 else f"1 in {every}",
                *(str(pdo[key]) if cyclic else "-" for key in _COUNTS),
                *(number(delays.get(key)) if cyclic else "-" for key in ("p50", "p99", "max")),
            )


_COUNTS: Final = ("cycles_expected", "lost", "lost_in_a_row", "after_the_next_sync")


def limit_lines(review: LogReview) -> Iterator[tuple[str, str, str, str]]:
    """Yield title, value, limit and result."""
    for check in review.checks:
        yield metric_title(check.metric), number(check.value), f"{check.limit:g}", check.result.value


def story_of(axis: AxisReview) -> list[tuple[float, str, str]]:
    """Return states, NMT states and EMCYs in order of time: s, what, text."""
    told = [(at, "state", state) for at, state in axis.states]
    told += [(at, "NMT", state) for at, state in axis.nmt]
    told += [(at, "EMCY", printable(text)) for at, text in axis.emergencies]
    return sorted(told)


def write_log_report(review: LogReview, path: Path) -> None:
    """Raises BadInput for a path that ends otherwise, or cannot be written to."""
    if path.suffix not in SUFFIXES:
        raise BadInput("--report", "", str(path), f"a file that ends in {' or '.join(SUFFIXES)}")
    write_file("--report", path, _log_html(review) if path.suffix == ".html" else _log_markdown(review))


def _log_tables(review: LogReview) -> Iterator[Table]:
    yield "Requirements", ("requirement", "value", "at most", ""), list(limit_lines(review))
    if review.unjudged:
        yield "Not told by a log", ("",), [(metric_title(key),) for key in review.unjudged]
    yield "Findings", ("",), [(printable(text),) for _, text in review.findings]
    yield "SYNC", ("",), [(line,) for line in sync_lines(review)]
    yield "PDOs", PDO_HEADS, list(pdo_rows(review))
    for axis in review.axes:
        story = [(f"{at:.6f}", what, text) for at, what, text in story_of(axis)]
        yield f"{axis.name}: states and EMCYs", ("at, s", "", ""), story[:_LINES_MAX]
    yield "Notes", ("",), [(note,) for note in review.notes]


def _log_pictures(review: LogReview) -> Iterator[tuple[str, str]]:
    from servobench.hil.recorded.paper import histogram_figure, paper_figure, svg_text

    if any(axis.reading is not None for axis in review.axes):
        yield (
            "Speed, torque and delay by the frames of the log; dashed: limits",
            svg_text(paper_figure(review.signals, "the log's first frame")),
        )
        yield "Delays of the readings after their SYNCs", svg_text(histogram_figure(review.signals))


def _title(review: LogReview) -> str:
    return f"{review.path.name} by {review.config.bench.name}"


def _log_html(review: LogReview) -> str:
    fair = " passed" if review.exit_status == ExitStatus.PASSED else ""
    parts = [f"<h1>{html.escape(_title(review))}</h1>"]
    parts.append(f"<p class='verdict{fair}'>{html.escape(review.verdict.upper())}</p>")
    for place, (title, heads, rows) in enumerate(_log_tables(review)):
        if rows:
            parts.append(f"<h2>{html.escape(title)}</h2>" + html_table(heads, rows, classes=_CLASSES))
        if not place:
            parts += [
                f"<figure>{svg}<figcaption>{words}</figcaption></figure>"
                for words, svg in _log_pictures(review)
            ]
    return html_page(_title(review), parts)


def _log_markdown(review: LogReview) -> str:
    parts = [f"# {_title(review)}: {review.verdict.upper()}"]
    for place, (title, heads, rows) in enumerate(_log_tables(review)):
        if rows:
            parts.append(f"## {title}\n\n" + "\n".join(_markdown_table(heads, rows)))
        if not place:
            for words, svg in _log_pictures(review):
                data = base64.b64encode(svg.encode()).decode()
                parts.append(f"![{words}](data:image/svg+xml;base64,{data})")
    return "\n\n".join(parts) + "\n"


def _markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(heads)} |"
    yield "|" + ":--|" * len(heads)
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', '/') for cell in row)} |"
