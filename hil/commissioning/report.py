"""The report of a commissioning: Markdown with pictures beside it, HTML with them inside, JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from drivers.errors import BenchError
from drivers.vendors.motor_objects import QUANTITIES
from hil.commissioning.findings import Findings
from hil.commissioning.outcome import StepRecord, StepVerdict
from hil.commissioning.report_html import html_report
from hil.commissioning.request import CommissionRequest
from hil.commissioning.session import Session
from hil.restoring.restore import Restoration
from hil.rows.run_files import COMMISSIONING_FIGURES

REPORT_FILE = "report.md"
HTML_FILE = "report.html"


@dataclass(slots=True)
class Commissioned:
    """How it ended."""

    begun_at: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    records: list[StepRecord] = field(default_factory=list)
    findings: Findings = field(default_factory=Findings)
    restoration: Restoration | None = None
    """None: nothing had been changed, or everything was stored."""
    stored: bool = False
    not_stored: str = ""
    """Why not, if it was asked for and the drive did not."""
    error: BenchError | None = None
    """What ended it early."""

    @property
    def passed(self) -> bool:
        """Every step that could be done was done, and the drive is as it was found, or stored."""
        failed = any(record.verdict is StepVerdict.FAILED for record in self.records)
        put_back = self.restoration is None or self.restoration.complete
        return self.error is None and not failed and put_back and not self.not_stored


def write_report(session: Session, result: Commissioned) -> None:
    """Write report.md and figures.json into the folder."""
    request, identity, records = session.request, session.found.identity, result.records
    lines = [f"# Commissioning of node {request.node} on {request.bus}", ""]
    if identity is not None:
        lines += [f"{identity}, revision {identity.revision:08X}h.", ""]
    if request.dry_run:
        lines += ["A dry run: nothing was written, and nothing moved.", ""]
    if result.error is not None:
        lines += [f"**Ended early:** {result.error}", ""]
    lines += _header(request, result)
    lines += _summary(records)
    lines += _faults(records)
    lines += _missing(records)
    lines += ["## How the drive was left", "", _left(request, result), ""]
    for number, record in enumerate(records, start=1):
        lines += _step(number, record)
    request.out.mkdir(parents=True, exist_ok=True)
    (request.out / REPORT_FILE).write_text("\n".join(lines), encoding="utf-8")
    figures = as_json(request, result)
    (request.out / COMMISSIONING_FIGURES).write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    (request.out / HTML_FILE).write_text(html_report(figures, request.out), encoding="utf-8")


def header_of(request: CommissionRequest, result: Commissioned) -> dict[str, Any]:
    """What a lab writes on top: when, with what, of which drive and motor."""
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
        "uncertainties": "expanded, k = 2; figures in N m are in proportion to the rated torque 6076h",
    }


def _stated(findings: Findings) -> str | dict[str, str]:
    """Whose word stands for what nothing measures."""
    if not any(each.told for each in findings.stated.values()):
        return "resistance, inductance, pole pairs: by the nameplate, or as said at the motor"
    return {
        QUANTITIES[name].title: f"{each.value:.4g} {QUANTITIES[name].unit}, {each.by}".replace(" ,", ",")
        for name, each in findings.stated.items()
        if name != "torque_constant_nm_a" or findings.torque_constant_nm_a is None
    }


def _header(request: CommissionRequest, result: Commissioned) -> list[str]:
    rows = ["| | |", "|---|---|"]
    for name, value in header_of(request, result).items():
        told = _in_words(value)
        if told:
            rows.append(f"| {name} | {_cell(told)} |")
    return [*rows, ""]


def _in_words(value: Any) -> str:
    """A value of the header; a table as key: value, its tables as their name with theirs behind it."""
    if isinstance(value, dict):
        parts = [
            f"{key}: {_in_words(each)}" if not isinstance(each, dict) else f"{key} ({_in_words(each)})"
            for key, each in value.items()
            if each not in (None, "", {})
        ]
        return ", ".join(parts)
    return "" if value is None else str(value)


def as_json(request: CommissionRequest, result: Commissioned) -> dict[str, Any]:
    """The same for programs."""
    restoration, findings = result.restoration, result.findings
    return {
        "header": header_of(request, result),
        "bus": request.bus,
        "node": request.node,
        "error": None if result.error is None else str(result.error),
        "stored": result.stored,
        "not_stored": result.not_stored,
        "restored": None if restoration is None else restoration.complete,
        "not_restored": [] if restoration is None else restoration.failures,
        "written": [
            {"object": str(key), "before": findings.originals.get(key, b"").hex(), "set": value.hex()}
            for key, value in sorted(findings.settings.items(), key=lambda item: str(item[0]))
        ],
        "undo": request.restore_command,
        "steps": [
            {
                "name": record.name,
                "title": record.title,
                "plan": record.plan,
                "limit": record.limit,
                "headline": record.outcome.headline or next(iter(record.outcome.lines), ""),
                "lines": record.outcome.lines,
                "pictures": record.outcome.pictures,
                "quantities": [asdict(each) for each in record.outcome.quantities],
                "verdict": record.verdict.value,
                "reason": record.reason,
                "faults": record.outcome.faults,
                "figures": record.outcome.figures,
            }
            for record in result.records
        ],
    }


def _summary(records: Sequence[StepRecord]) -> list[str]:
    rows = ["| step | result | |", "|---|---|---|"]
    for record in records:
        outcome = record.outcome
        note = record.reason or outcome.headline or (outcome.lines[0] if outcome.lines else "")
        rows.append(f"| {record.title} | {record.verdict.value} | {_cell(note)} |")
    return [*rows, ""]


def _faults(records: Sequence[StepRecord]) -> list[str]:
    faults = [f"- {fault}" for record in records for fault in record.outcome.faults] or ["None was found."]
    return ["## Faults in the drive's settings", "", *faults, ""]


def _missing(records: Sequence[StepRecord]) -> list[str]:
    absent = [record for record in records if record.verdict not in (StepVerdict.DONE, StepVerdict.FAILED)]
    if not absent:
        return []
    listed = (f"- {record.title}: {record.verdict.value}, {record.reason}" for record in absent)
    return ["## Left out", "", *listed, ""]


def _left(request: CommissionRequest, result: Commissioned) -> str:
    restoration = result.restoration
    if result.not_stored:
        return (
            f"The settings were NOT stored in the drive: {result.not_stored}. It keeps them until it is "
            "switched off; the journal still holds what was there before."
        )
    if result.stored:
        return "The settings were stored in the drive (1010h); the journal still holds what was there before."
    if restoration is None:
        return "Nothing was changed."
    if restoration.complete:
        return (
            f"All {restoration.objects} objects that were changed hold again, byte for byte, what they held "
            "before; each was read back."
        )
    return (
        f"Not all is as it was: {'; '.join(restoration.failures)}. `{request.restore_command}` tries again."
    )


def _step(number: int, record: StepRecord) -> list[str]:
    lines = [f"## {number}. {record.title}", ""]
    if record.plan:
        lines += [f"*{record.plan[0].upper()}{record.plan[1:]}.*", ""]
    if record.limit:
        lines += [f"It fails if {record.limit}.", ""]
    if record.verdict is not StepVerdict.DONE:
        lines += [f"**{record.verdict.value}**: {record.reason}", ""]
    for line in record.outcome.lines:
        lines.append(line if line.startswith("- ") else f"- {line}")
    lines += [f"- **found**: {fault}" for fault in record.outcome.faults]
    if record.outcome.lines or record.outcome.faults:
        lines.append("")
    for picture in record.outcome.pictures:
        lines += [f"![{record.title}]({picture})", ""]
    return lines


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
