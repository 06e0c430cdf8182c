"""The report of a commissioning: Markdown with separate pictures, HTML with embedded ones, JSON."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import BenchError
from servobench.drivers.vendors.motor_objects import QUANTITIES
from servobench.hil.commissioning.drive_left import DriveLeft, changed_objects
from servobench.hil.commissioning.findings import (
    BY_NAMEPLATE,
    Findings,
    StatedFigure,
    StepRecord,
    StepVerdict,
)
from servobench.hil.commissioning.request import CommissionRequest
from servobench.hil.commissioning.torque_scale import TorqueScale, is_proportional, torque_scale
from servobench.hil.reviewing.html_page import html_page, html_pairs, html_table
from servobench.hil.rows.run_files import COMMISSIONING_FIGURES
from servobench.hil.verdict.verdict import ExitStatus

REPORT_FILE = "report.md"
HTML_FILE = "report.html"


@dataclass(slots=True)
class Commissioned:
    """The end of a commissioning."""

    begun_at: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    records: list[StepRecord] = field(default_factory=list)
    findings: Findings = field(default_factory=Findings)
    left: DriveLeft = field(default_factory=DriveLeft)
    error: BenchError | None = None
    """The error that ended it early."""
    defect: str = ""
    """A program defect that ended it, or that is under way while the report is written."""
    disturbances: tuple[str, ...] = ()
    """Forbidden frames from others on the bus: first frame, its time, count."""

    @property
    def passed(self) -> bool:
        """True if every possible step was done, and the drive is as found, or stored."""
        failed = any(record.verdict is StepVerdict.FAILED for record in self.records)
        left = self.left.stored or (self.left.as_found and not self.left.not_stored)
        return self.error is None and not failed and left

    @property
    def exit_status(self) -> int:
        """Exit status of the command."""
        if self.error is not None:
            return self.error.exit_status
        if not self.passed:
            return ExitStatus.FAILED
        return ExitStatus.NOT_TRUSTWORTHY if self.disturbances else ExitStatus.PASSED

    @property
    def verdict(self) -> str:
        """In capitals, and what keeps it from being passed: what a reader sees first."""
        failed = [each.title for each in self.records if each.verdict is StepVerdict.FAILED]
        reasons = ["it ended early"] if self.ended_by else []
        reasons += [f"failed: {', '.join(failed)}"] if failed else []
        if not self.passed and not reasons:
            reasons.append("the drive is not left as it was found, nor stored")
        if self.disturbances and not reasons:
            return "PASSED, DISTURBED"
        return f"NOT PASSED: {'; '.join(reasons)}" if reasons else "PASSED"

    @property
    def ended_by(self) -> str:
        """The reason in words; empty if it came to its end."""
        return self.defect if self.error is None else str(self.error)


def write_report(request: CommissionRequest, result: Commissioned) -> None:
    """Write report.md, report.html and figures.json into the folder."""
    out = request.out
    figures = as_json(request, result)
    (out / COMMISSIONING_FIGURES).write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    (out / REPORT_FILE).write_text(_markdown(request, result, figures), encoding="utf-8")
    (out / HTML_FILE).write_text(_html(figures, out), encoding="utf-8")


def header_of(request: CommissionRequest, result: Commissioned) -> dict[str, Any]:
    """Return the report's header: date, tool, drive and motor."""
    identity = result.findings.identity
    drive = {} if identity is None else {
        "name (1008h)": identity.device_name,
        "vendor (1018h:1)": f"{identity.vendor:08X}h",
        "product (1018h:2)": f"{identity.product:08X}h",
        "revision (1018h:3)": f"{identity.revision:08X}h",
        "serial number (1018h:4)": identity.serial,
        **result.findings.versions,
    }  # fmt: skip
    return {
        "date": result.begun_at,
        "tool": f"servobench {version('servobench')}",
        "adapter": request.bus,
        "bit rate, bit/s": request.bitrate_bit_s,
        "node": request.node,
        "data sheet": None if request.eds is None else request.eds.name,
        "drive": drive,
        "nameplate": request.nameplate.model_dump(exclude_none=True, exclude={"limits"}),
        "limits": request.nameplate.limits.model_dump(exclude_none=True),
        "not measurable over CiA 402": _stated(result.findings),
        "by the nameplate alone": ", ".join(_by_plate_alone(request, result)),
        "uncertainties": "expanded, k = 2, by the scatter of the fit, without that of the torque scale",
        "torque scale": None if (scale := _scale(request, result)) is None else scale.sentence,
    }


def _scale(request: CommissionRequest, result: Commissioned) -> TorqueScale | None:
    return torque_scale(result.findings, request.nameplate)


def _by_plate_alone(request: CommissionRequest, result: Commissioned) -> list[str]:
    """Return keys of the nameplate that were compared with each other only, within wide bands."""
    plate, findings, scale = request.nameplate, result.findings, _scale(request, result)
    motor, rating = plate.motor, plate.rating
    alone = {
        "rating.torque_nm": rating.torque_nm and scale is not None and scale.ratio is None,
        "rating.speed_rpm": rating.speed_rpm,
        "rating.current_a": rating.current_a and findings.rated_current_a is None,
        "rating.current_max_a": rating.current_max_a,
        "rating.dc_bus_voltage_v": rating.dc_bus_voltage_v
        and Object.DC_LINK_CIRCUIT_VOLTAGE not in _read(findings),
        "motor.inertia_kg_m2": motor.inertia_kg_m2,
        **{
            f"motor.{name}": getattr(motor, name) and name not in findings.motor.figures
            for name in ("resistance_ohm", "inductance_d_h", "inductance_q_h")
        },
        "motor.pole_pairs": "pole_pairs" in findings.stated
        and findings.stated["pole_pairs"].by == BY_NAMEPLATE,
    }
    return [key for key, is_alone in alone.items() if is_alone]


def _read(findings: Findings) -> set[int]:
    """Return the indices of the objects that the drive has."""
    return {index for index, _ in findings.dump}


def summary_of(request: CommissionRequest, result: Commissioned) -> list[str]:
    """Summarise the result in a line, and the basis of its torques in another."""
    done = sum(record.verdict is StepVerdict.DONE for record in result.records)
    faults = sum(len(record.outcome.faults) for record in result.records)
    scale = _scale(request, result) if result.findings.mechanics is not None else None
    found = f"{faults} faults found"
    if scale is not None and scale.ratio is None:
        found = f"{faults or 'no'} faults found with a torque scale that nothing measured"
    lines = [f"{done} of {len(result.records)} steps done, {found}; see {request.out / HTML_FILE}"]
    if scale is not None:
        lines.append(f"each of inertia, friction and gains {scale.sentence}")
    return [*lines, *(f"disturbed: {each}" for each in result.disturbances)]


def _stated(findings: Findings) -> str | dict[str, str]:
    """Return the sources of the unmeasurable quantities."""
    if not any(each.told for each in findings.stated.values()):
        return "resistance, inductance, pole pairs: by the nameplate, or as said at the motor"
    return {
        QUANTITIES[name].title: f"{each.value:.4g} {QUANTITIES[name].unit}, {each.by}".replace(" ,", ",")
        for name, each in findings.stated.items()
        if name != "torque_constant_nm_a" or findings.torque_constant_nm_a is None
    }


def _in_words(value: Any) -> str:
    """Format a value of the header; a table as key: value, nested tables by their name."""
    if isinstance(value, dict):
        parts = [
            f"{key}: {_in_words(each)}" if not isinstance(each, dict) else f"{key} ({_in_words(each)})"
            for key, each in value.items()
            if each not in (None, "", {})
        ]
        return ", ".join(parts)
    return "" if value is None else str(value)


def as_json(request: CommissionRequest, result: Commissioned) -> dict[str, Any]:
    """Return the report for programs."""
    left, findings = result.left, result.findings
    restoration = left.restoration
    scale = _scale(request, result)
    return {
        "header": header_of(request, result),
        "purpose": request.purpose,
        "bus": request.bus,
        "node": request.node,
        "error": result.ended_by or None,
        "verdict": result.verdict,
        "exit_status": int(result.exit_status),
        "disturbed": list(result.disturbances),
        "left": left.as_json(request),
        "stored": left.stored,
        "not_stored": left.not_stored,
        "restored": None if restoration is None else restoration.complete,
        "not_restored": [] if restoration is None else restoration.failures,
        "written": changed_objects(findings),
        "undo": request.restore_command,
        "torque_scale": None if scale is None else scale.as_json(),
        "steps": [
            {
                "name": record.name,
                "title": record.title,
                "plan": record.plan,
                "limit": record.limit,
                "headline": record.outcome.headline or next(iter(record.outcome.lines), ""),
                "lines": record.outcome.lines,
                "pictures": record.outcome.pictures,
                "quantities": [_quantity(each, scale) for each in record.outcome.quantities],
                "verdict": record.verdict.value,
                "reason": record.reason,
                "faults": record.outcome.faults,
                "figures": record.outcome.figures,
            }
            for record in result.records
        ],
    }


def _quantity(figure: StatedFigure, scale: TorqueScale | None) -> dict[str, Any]:
    """Return the quantity, with the torque scale and its relative uncertainty if it is proportional to the
    torque."""
    if scale is None or not is_proportional(figure.unit):
        return asdict(figure)
    return {**asdict(figure), "scale_uncertainty": scale.uncertainty, "rests_on": scale.sentence}


def _rests_on(step: Mapping[str, Any]) -> str:
    """Name the basis of a step's figures; empty if none is proportional to the torque."""
    sentences = [(each["name"], each["rests_on"]) for each in step["quantities"] if "rests_on" in each]
    return f"{', '.join(name for name, _ in sentences)}: {sentences[0][1]}" if sentences else ""


def _title(figures: Mapping[str, Any]) -> str:
    return f"{figures['purpose'].capitalize()} of node {figures['node']} on {figures['bus']}"


def _results(figures: Mapping[str, Any]) -> list[list[str]]:
    """Return title, verdict and one sentence of each step."""
    return [[step["title"], step["verdict"], step["reason"] or step["headline"]] for step in figures["steps"]]


def _faults(figures: Mapping[str, Any]) -> list[str]:
    return [fault for step in figures["steps"] for fault in step["faults"]] or ["None was found."]


def _markdown(request: CommissionRequest, result: Commissioned, figures: Mapping[str, Any]) -> str:
    identity = result.findings.identity
    lines = [f"# {_title(figures)}", "", f"**{figures['verdict']}**", ""]
    if identity is not None:
        lines += [f"{identity}, revision {identity.revision:08X}h.", ""]
    if request.dry_run:
        lines += ["A dry run: nothing was written, and nothing moved.", ""]
    if result.ended_by:
        lines += [f"**Ended early:** {result.ended_by}", ""]
    header = ((name, _in_words(value)) for name, value in figures["header"].items())
    lines += ["| | |", "|---|---|", *(_row(name, told) for name, told in header if told), ""]
    lines += ["| step | result | |", "|---|---|---|", *(_row(*row) for row in _results(figures)), ""]
    lines += ["## Faults in the drive's settings", "", *(f"- {fault}" for fault in _faults(figures)), ""]
    absent = [step for step in figures["steps"] if step["verdict"] not in ("done", "failed")]
    if absent:
        listed = (f"- {step['title']}: {step['verdict']}, {step['reason']}" for step in absent)
        lines += ["## Left out", "", *listed, ""]
    lines += ["## How the drive was left", "", *figures["left"]["text"], ""]
    for number, step in enumerate(figures["steps"], start=1):
        lines += _markdown_step(number, step)
    return "\n".join(lines)


def _row(*cells: str) -> str:
    escaped = (cell.replace("|", "\\|").replace("\n", " ") for cell in cells)
    return f"| {' | '.join(escaped)} |"


def _markdown_step(number: int, step: Mapping[str, Any]) -> list[str]:
    lines = [f"## {number}. {step['title']}", ""]
    if step["plan"]:
        lines += [f"*{step['plan'][0].upper()}{step['plan'][1:]}.*", ""]
    if step["limit"]:
        lines += [f"It fails if {step['limit']}.", ""]
    if step["verdict"] != "done":
        lines += [f"**{step['verdict']}**: {step['reason']}", ""]
    said = [line if line.startswith("- ") else f"- {line}" for line in step["lines"]]
    rests = _rests_on(step)
    said += [f"- {rests}"] if rests and not any("rests on the" in line for line in said) else []
    said += [f"- **found**: {fault}" for fault in step["faults"]]
    lines += [*said, ""] if said else []
    for picture in step["pictures"]:
        lines += [f"![{step['title']}]({picture})", ""]
    return lines


def _html(figures: Mapping[str, Any], folder: Path) -> str:
    """Return one HTML file, with the pictures, read from ``folder``, embedded."""
    fair = " passed" if figures["exit_status"] == ExitStatus.PASSED else ""
    verdict = f"<p class='verdict{fair}'>{_text(figures['verdict'])}</p>"
    body = [f"<h1>{_text(_title(figures))}</h1>", verdict, html_pairs(figures["header"])]
    if figures["error"]:
        body.append(f"<p class='failed'>Ended early: {_text(figures['error'])}</p>")
    body += ["<h2>Result</h2>", html_table(["step", "result", ""], _results(figures))]
    body += ["<h2>Faults in the drive's settings</h2>", _list(_faults(figures))]
    body += ["<h2>How the drive was left</h2>", _list(figures["left"]["text"])]
    body += _written(figures)
    for number, step in enumerate(figures["steps"], start=1):
        body += _html_step(number, step, folder)
    return html_page(_title(figures), body)


def _written(figures: Mapping[str, Any]) -> list[str]:
    rows = [
        [each["object"], each["name"], each["before_told"], each["set_told"]] for each in figures["written"]
    ]
    if not rows:
        return ["<h2>Written to the drive</h2>", "<p>Nothing.</p>"]
    undo = f"<p>To undo: <code>{_text(figures['undo'])}</code></p>"
    return ["<h2>Written to the drive</h2>", html_table(["object", "name", "before", "set"], rows), undo]


def _html_step(number: int, step: Mapping[str, Any], folder: Path) -> list[str]:
    lines = [f"<h2>{number}. {_text(step['title'])}</h2>"]
    if step["plan"]:
        lines.append(f"<p><em>{_text(step['plan'])}</em></p>")
    if step["limit"]:
        lines.append(f"<p>It fails if {_text(step['limit'])}.</p>")
    if step["verdict"] != "done":
        lines.append(f"<p class='failed'>{_text(step['verdict'])}: {_text(step['reason'])}</p>")
    if step["quantities"]:
        rows = [
            [
                each["name"],
                _figure(each["value"]),
                _figure(each["uncertainty"]),
                _of_scale(each),
                each["unit"],
            ]
            for each in step["quantities"]
        ]
        lines.append(
            html_table(["quantity", "value", "of the fit, k = 2", "of the torque scale, k = 2", "unit"], rows)
        )
        if _rests_on(step):
            lines.append(f"<p>{_text(_rests_on(step))}.</p>")
    lines.append(_list([line.removeprefix("- ") for line in step["lines"]]))
    for picture in step["pictures"]:
        data = base64.b64encode((folder / picture).read_bytes()).decode("ascii")
        lines.append(f"<p><img alt='{_text(step['title'])}' src='data:image/png;base64,{data}'></p>")
    return lines


def _list(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{_text(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _figure(value: float | None) -> str:
    """Whole numbers in full: counts and rates."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 1e4 and value.is_integer() else f"{value:.4g}"


def _of_scale(quantity: Mapping[str, Any]) -> str:
    """Format the torque scale's uncertainty for a proportional figure."""
    if "rests_on" not in quantity:
        return ""
    share = quantity["scale_uncertainty"]
    return "unknown" if share is None else f"{100.0 * share:.2g} %"


def _text(value: Any) -> str:
    return escape(str(value), quote=True)
