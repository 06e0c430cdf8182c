"""The report of a commissioning as a lab files it: one HTML file with its pictures inside."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

_STYLE: Final = """
body{font:15px/1.45 sans-serif;color:#1c2733;max-width:60em;margin:2em auto;padding:0 1em}
table{border-collapse:collapse;margin:.6em 0}th,td{border:1px solid #ccd3da;padding:.2em .6em;text-align:left}
th{background:#f2f4f7}img{max-width:100%}.failed{color:#b3261e;font-weight:bold}h2{margin-top:1.6em}
@media print{h2{break-after:avoid}img{break-inside:avoid}}
"""


def html_report(figures: Mapping[str, Any], folder: Path) -> str:
    """The page, from what ``figures.json`` holds; pictures are read from ``folder``."""
    header = figures["header"]
    title = f"Commissioning of node {figures['node']} on {figures['bus']}"
    body = [f"<h1>{_text(title)}</h1>", _pairs(header)]
    if figures["error"]:
        body.append(f"<p class='failed'>Ended early: {_text(figures['error'])}</p>")
    body += ["<h2>Result</h2>", _steps_table(figures["steps"])]
    faults = [fault for step in figures["steps"] for fault in step["faults"]]
    body += ["<h2>Faults in the drive's settings</h2>", _list(faults or ["None was found."])]
    body += _written(figures)
    for number, step in enumerate(figures["steps"], start=1):
        body += _step(number, step, folder)
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{_text(title)}</title>"
        f"<style>{_STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )


def _written(figures: Mapping[str, Any]) -> list[str]:
    rows = [[each["object"], each["before"], each["set"]] for each in figures["written"]]
    left = "They are stored in the drive." if figures["stored"] else "All were put back at the end."
    if figures["not_restored"]:
        left = f"Not put back: {'; '.join(figures['not_restored'])}."
    if not rows:
        return ["<h2>Written to the drive</h2>", "<p>Nothing.</p>"]
    undo = f"<p>{_text(left)} To undo: <code>{_text(figures['undo'])}</code></p>"
    return ["<h2>Written to the drive</h2>", _table(["object", "before, hex", "set, hex"], rows), undo]


def _steps_table(steps: Sequence[Mapping[str, Any]]) -> str:
    rows = [[step["title"], step["verdict"], step["reason"] or step["headline"]] for step in steps]
    return _table(["step", "result", ""], rows)


def _step(number: int, step: Mapping[str, Any], folder: Path) -> list[str]:
    lines = [f"<h2>{number}. {_text(step['title'])}</h2>"]
    if step["plan"]:
        lines.append(f"<p><em>{_text(step['plan'])}</em></p>")
    if step["limit"]:
        lines.append(f"<p>It fails if {_text(step['limit'])}.</p>")
    if step["verdict"] != "done":
        lines.append(f"<p class='failed'>{_text(step['verdict'])}: {_text(step['reason'])}</p>")
    if step["quantities"]:
        rows = [
            [each["name"], _figure(each["value"]), _figure(each["uncertainty"]), each["unit"]]
            for each in step["quantities"]
        ]
        lines.append(_table(["quantity", "value", "uncertainty, k = 2", "unit"], rows))
    lines.append(_list([line.removeprefix("- ") for line in step["lines"]]))
    for picture in step["pictures"]:
        data = base64.b64encode((folder / picture).read_bytes()).decode("ascii")
        lines.append(f"<p><img alt='{_text(step['title'])}' src='data:image/png;base64,{data}'></p>")
    return lines


def _pairs(values: Mapping[str, Any]) -> str:
    return _table([], [[name, value] for name, value in values.items() if value not in (None, "", {})])


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    titles = "".join(f"<th>{_text(name)}</th>" for name in head)
    lines = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table>{f'<tr>{titles}</tr>' if titles else ''}{lines}</table>"


def _cell(value: Any) -> str:
    return _pairs(value) if isinstance(value, Mapping) else _text(value)


def _list(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{_text(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _text(value: Any) -> str:
    return escape(str(value), quote=True)
