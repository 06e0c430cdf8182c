"""The report of a commissioning: Markdown with pictures beside it, and the figures for programs."""

import json
from collections.abc import Sequence
from typing import Any

from drivers.errors import BenchError
from hil.commissioning.outcome import StepRecord, Verdict
from hil.commissioning.request import CommissionRequest
from hil.commissioning.session import Session
from hil.restoring.restore import Restoration

REPORT_FILE = "report.md"
FIGURES_FILE = "figures.json"


def write_report(
    session: Session,
    records: Sequence[StepRecord],
    restoration: Restoration | None,
    stored: bool,
    error: BenchError | None,
) -> None:
    """Write report.md and figures.json into the folder."""
    request, identity = session.request, session.found.identity
    lines = [f"# Commissioning of node {request.node} on {request.bus}", ""]
    if identity is not None:
        lines += [f"{identity}, revision {identity.revision:08X}h.", ""]
    if request.dry_run:
        lines += ["A dry run: nothing was written, and nothing moved.", ""]
    if error is not None:
        lines += [f"**Ended early:** {error}", ""]
    lines += _summary(records)
    lines += _faults(records)
    lines += _missing(records)
    lines += ["## How the drive was left", "", _left(session, restoration, stored), ""]
    for number, record in enumerate(records, start=1):
        lines += _step(number, record)
    request.out.mkdir(parents=True, exist_ok=True)
    (request.out / REPORT_FILE).write_text("\n".join(lines), encoding="utf-8")
    figures = json.dumps(as_json(request, records, restoration, stored, error), indent=1)
    (request.out / FIGURES_FILE).write_text(figures + "\n", encoding="utf-8")


def as_json(
    request: CommissionRequest,
    records: Sequence[StepRecord],
    restoration: Restoration | None,
    stored: bool,
    error: BenchError | None,
) -> dict[str, Any]:
    """The same for programs."""
    return {
        "bus": request.bus,
        "node": request.node,
        "error": None if error is None else str(error),
        "stored": stored,
        "restored": None if restoration is None else restoration.complete,
        "not_restored": [] if restoration is None else restoration.failures,
        "steps": [
            {
                "name": record.name,
                "verdict": record.verdict.value,
                "reason": record.reason,
                "faults": record.outcome.faults,
                "figures": record.outcome.figures,
            }
            for record in records
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
    found = [fault for record in records for fault in record.outcome.faults]
    if not found:
        return ["## Faults in the drive's settings", "", "None was found.", ""]
    return ["## Faults in the drive's settings", "", *(f"- {fault}" for fault in found), ""]


def _missing(records: Sequence[StepRecord]) -> list[str]:
    absent = [record for record in records if record.verdict not in (Verdict.DONE, Verdict.FAILED)]
    if not absent:
        return []
    listed = (f"- {record.title}: {record.verdict.value}, {record.reason}" for record in absent)
    return ["## Left out", "", *listed, ""]


def _left(session: Session, restoration: Restoration | None, stored: bool) -> str:
    if stored:
        return "The settings were stored in the drive (1010h); the journal still holds what was there before."
    if restoration is None:
        return "Nothing was changed."
    if restoration.complete:
        return (
            f"All {restoration.objects} objects that were changed hold again, byte for byte, what they held "
            "before; each was read back."
        )
    journal = session.request.journal
    failures = "; ".join(restoration.failures)
    command = f"hil restore --bus {session.request.bus} --node {session.request.node} {journal}"
    return f"Not all is as it was: {failures}. `{command}` tries again."


def _step(number: int, record: StepRecord) -> list[str]:
    lines = [f"## {number}. {record.title}", ""]
    if record.plan:
        lines += [f"*{record.plan[0].upper()}{record.plan[1:]}.*", ""]
    if record.verdict is not Verdict.DONE:
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
