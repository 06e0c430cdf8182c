"""The certificate of a commissioning, to be printed, signed and filed: verdict first, then who, what, when,
each figure with its uncertainty, each object before and after, and what was not determined.

It is written at every end, as HTML, PDF and JSON, beside ``manifest.sha256``, which lists every other file of
the folder; the certificate bears the manifest's own digest.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

from servobench.drivers.errors import printable
from servobench.hil.commissioning.drive_left import changed_objects
from servobench.hil.commissioning.report import Commissioned, as_json
from servobench.hil.commissioning.request import CommissionRequest
from servobench.hil.reviewing.html_page import html_page, html_table

NAME: Final = "certificate"
MANIFEST_FILE: Final = "manifest.sha256"
_OWN: Final = frozenset({MANIFEST_FILE, *(f"{NAME}.{kind}" for kind in ("html", "pdf", "json"))})
_MEASURING: Final = frozenset({"mechanics", "torque_constant", "voltage_constant", "response", "delays"})
"""Steps that are there for figures; the others set, prove, read or compare."""
_BLOCK: Final = 1 << 20
_SIGN_CSS: Final = (
    "<style>.sign{display:flex;gap:2em;margin-top:3em}.sign div{flex:1;border-top:1px solid;padding-top:.3em}"
    "</style>"
)
SIGNATURES: Final = ("operator: name, date, signature", "approved: name, date, signature")
Rows = Sequence[Sequence[str]]


class CertificateTable(NamedTuple):
    """One section."""

    title: str
    heads: tuple[str, ...]
    rows: Rows
    widths: tuple[float, ...]
    """Shares of a page's width."""
    empty: str = ""
    """Text where there is no row; empty: the section is left out."""


class FiledCertificate(NamedTuple):
    """A certificate in words."""

    title: str
    verdict: str
    passed: bool
    sheets: tuple[CertificateTable, ...]
    manifest_sha256: str


def write_certificate(request: CommissionRequest, result: Commissioned) -> None:
    """Write manifest and certificate into the folder, into which nothing else is written any more. Raises
    OSError."""
    from servobench.hil.commissioning.certificate_pdf import write_pdf

    figures = as_json(request, result)
    ended_at = datetime.now(UTC).isoformat(timespec="seconds")
    digest = _write_manifest(request.out)
    made = certificate(request, result, figures, ended_at, digest)
    plain = {
        "verdict": made.verdict,
        "passed": made.passed,
        "manifest_sha256": digest,
        "tables": {
            sheet.title: [dict(zip(sheet.heads, row, strict=True)) for row in sheet.rows]
            for sheet in made.sheets
        },
    }
    (request.out / f"{NAME}.json").write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
    (request.out / f"{NAME}.html").write_text(_html(made), encoding="utf-8")
    write_pdf(made, request.out / f"{NAME}.pdf")


def certificate(
    request: CommissionRequest, result: Commissioned, figures: Mapping[str, Any], ended_at: str, digest: str
) -> FiledCertificate:
    """Return the certificate. ``digest``: SHA-256 of the manifest."""
    left = figures["left"]
    sheets = (
        CertificateTable(
            "Commissioning",
            ("item", "value"),
            list(_subject(request, result, figures, ended_at)),
            (0.28, 0.72),
        ),
        CertificateTable(
            "Steps", ("step", "result", "found"), list(_steps(figures)), (0.27, 0.12, 0.61), "None was begun."
        ),
        CertificateTable(
            "Determined",
            ("quantity", "value", "U (k = 2)", "unit", "by the step"),
            list(_determined(figures)),
            (0.34, 0.16, 0.14, 0.12, 0.24),
            "Nothing.",
        ),
        CertificateTable(
            "Uncertainty budget, k = 2",
            ("quantity", "of the fit", "of the torque scale", "together", "unit"),
            list(_budget(figures)),
            (0.34, 0.16, 0.22, 0.16, 0.12),
        ),
        CertificateTable(
            "Not determined",
            ("what", "why"),
            list(_undetermined(figures)),
            (0.34, 0.66),
            "Nothing is left open.",
        ),
        CertificateTable(
            "Faults in the drive's settings",
            ("step", "fault"),
            [(step["title"], fault) for step in figures["steps"] for fault in step["faults"]],
            (0.27, 0.73),
            "None was found.",
        ),
        CertificateTable(
            f"Objects that were changed; now {left['settings']}",
            ("object", "name", "before", "set to", "left at"),
            list(_objects(result, figures)),
            (0.1, 0.3, 0.2, 0.2, 0.2),
            "None.",
        ),
        CertificateTable(
            "How the drive was left", ("statement",), [(text,) for text in left["text"]], (1.0,)
        ),
    )
    title = f"Certificate of commissioning: node {request.node} on {request.bus}"
    cleaned = tuple(
        sheet._replace(rows=[[printable(str(cell)) for cell in row] for row in sheet.rows])
        for sheet in sheets
    )
    return FiledCertificate(printable(title), result.verdict, result.passed, cleaned, digest)


def _subject(
    request: CommissionRequest, result: Commissioned, figures: Mapping[str, Any], ended_at: str
) -> Iterator[tuple[str, str]]:
    lab = request.laboratory
    for name, text in (("operator", lab.operator), ("site", lab.site), ("order", lab.order)):
        yield name, text or "not told"
    yield "begun, ended", f"{result.begun_at}, {ended_at}"
    if figures["error"]:
        yield "ended early by", figures["error"]
    if request.dry_run:
        yield "dry run", "nothing was written, and nothing moved"
    drive = figures["header"]["drive"]
    yield "drive", ", ".join(f"{key} {value}" for key, value in drive.items()) or "not read"
    motor, rating = request.nameplate.motor, request.nameplate.rating
    plate = [f"{key} {value:.6g}" for key, value in rating.model_dump(exclude_none=True).items()]
    yield "motor, by its nameplate", ", ".join([motor.name or "unnamed", *plate])
    yield "bus", f"{request.bus}, {request.bitrate_bit_s} bit/s, node {request.node}"
    yield "tool", f"servobench {version('servobench')}"
    yield "torque scale", figures["header"]["torque scale"] or "unknown"
    yield "folder", str(request.out.resolve())


def _steps(figures: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    for step in figures["steps"]:
        nothing = step["verdict"] == "done" and step["name"] in _MEASURING and not step["quantities"]
        verdict = "done, nothing determined" if nothing else step["verdict"]
        yield step["title"], verdict, step["reason"] or step["headline"]


def _determined(figures: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    for step in figures["steps"]:
        for each in step["quantities"]:
            value, uncertainty = told_figure(each["value"], together(each))
            yield each["name"], value, uncertainty or "not known", each["unit"] or "1", step["title"]


def _budget(figures: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    for step in figures["steps"]:
        for each in step["quantities"]:
            if each["uncertainty"] is None and "scale_uncertainty" not in each:
                continue
            share = each.get("scale_uncertainty")
            scale = "none" if "scale_uncertainty" not in each else "not known"
            if share is not None:
                scale = f"{_two_digits(abs(each['value']) * share)} ({100 * share:.2g} %)"
            yield (
                each["name"],
                "not known" if each["uncertainty"] is None else _two_digits(each["uncertainty"]),
                scale,
                "not known" if (both := together(each)) is None else _two_digits(both),
                each["unit"] or "1",
            )


def together(quantity: Mapping[str, Any]) -> float | None:
    """Return the expanded uncertainty of a quantity, k = 2: that of the fit and that of the torque scale,
    which are independent; None if one of them is not known."""
    fit = quantity["uncertainty"]
    if "scale_uncertainty" not in quantity:
        return None if fit is None else float(fit)
    share = quantity["scale_uncertainty"]
    return None if fit is None or share is None else math.hypot(fit, share * quantity["value"])


def told_figure(value: float, uncertainty: float | None) -> tuple[str, str]:
    """Return a value and its uncertainty with two significant digits of the latter; without one the value has
    four, and whole numbers are told in full."""
    if uncertainty is None or uncertainty <= 0 or not math.isfinite(uncertainty):
        return (f"{value:.0f}" if float(value).is_integer() else f"{value:#.4g}".removesuffix(".")), ""
    last = math.floor(math.log10(float(f"{uncertainty:.1e}"))) - 1
    if last >= 0:
        return f"{round(value, -last):.0f}", f"{round(uncertainty, -last):.0f}"
    power = math.floor(math.log10(abs(value))) if value else 0
    if power >= -3:
        return f"{value:.{-last}f}", f"{uncertainty:.{-last}f}"
    digits, scale = max(0, power - last), 10.0**power
    return f"{value / scale:.{digits}f}e{power}", f"{uncertainty / scale:.{digits}f}e{power}"


def _two_digits(value: float) -> str:
    return f"{value:#.2g}".removesuffix(".")


def _undetermined(figures: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for step in figures["steps"]:
        if step["verdict"] != "done":
            yield step["title"], f"{step['verdict']}: {step['reason']}".removesuffix(": ")
        elif step["name"] in _MEASURING and not step["quantities"]:
            yield step["title"], step["headline"]
    for step in figures["steps"]:
        for each in step["quantities"]:
            if together(each) is None:
                yield f"uncertainty of: {each['name']}", _why_unknown(each)
    stated = figures["header"]["not measurable over CiA 402"]
    yield from stated.items() if isinstance(stated, Mapping) else [("not measurable over CiA 402", stated)]
    if alone := figures["header"]["by the nameplate alone"]:
        yield "compared with nothing but the nameplate itself", alone


def _why_unknown(quantity: Mapping[str, Any]) -> str:
    if quantity.get("scale_uncertainty", 0.0) is None:
        return "nothing measured the torque scale"
    return "the step states none"


def _objects(result: Commissioned, figures: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    restored = figures["left"]["settings"] == "restored"
    for each in changed_objects(result.findings):
        before, after = each["before_decimal"], each["set_decimal"]
        yield each["object"], each["name"] or "of the maker", before, after, before if restored else after


def _write_manifest(folder: Path) -> str:
    """Write the manifest, as sha256sum -c reads it; return its digest."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in _OWN]
    lines = [f"{_sha256(path)}  {path.relative_to(folder).as_posix()}\n" for path in files]
    text = "".join(lines).encode()
    (folder / MANIFEST_FILE).write_bytes(text)
    return hashlib.sha256(text).hexdigest()


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def hash_line(made: FiledCertificate) -> str:
    """Return how the folder's files are held against the certificate."""
    return f"SHA-256 of {MANIFEST_FILE}, which lists every file of the folder: {made.manifest_sha256}"


def _html(made: FiledCertificate) -> str:
    mark = " passed" if made.verdict == "PASSED" else ""
    parts = [
        _SIGN_CSS,
        f"<h1>{escape(made.title)}</h1>",
        f"<p class='verdict{mark}'>{escape(made.verdict)}</p>",
    ]
    for sheet in made.sheets:
        if sheet.rows:
            parts.append(f"<h2>{escape(sheet.title)}</h2>{html_table(sheet.heads, sheet.rows)}")
        elif sheet.empty:
            parts.append(f"<h2>{escape(sheet.title)}</h2><p>{escape(sheet.empty)}</p>")
    parts.append(
        f"<p>{escape(hash_line(made))}<br>sha256sum -c {MANIFEST_FILE}; sha256sum {MANIFEST_FILE}</p>"
    )
    parts.append(f"<div class='sign'>{''.join(f'<div>{text}</div>' for text in SIGNATURES)}</div>")
    return html_page(made.title, parts)
