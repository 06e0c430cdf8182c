"""The report of a commissioning, step by step, as Markdown and as one HTML file."""

import base64
import json
from html import escape
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.cia402.told_motor import ToldFigure
from servobench.drivers.errors import NoAnswer
from servobench.hil.commissioning.drive_left import DriveLeft
from servobench.hil.commissioning.findings import (
    BY_NAMEPLATE,
    Findings,
    Stated,
    StatedFigure,
    StepOutcome,
    StepRecord,
    StepVerdict,
)
from servobench.hil.commissioning.report import Commissioned, header_of, write_report
from servobench.hil.commissioning.request import CommissionRequest
from servobench.hil.restoring.journal import ObjectKey
from servobench.hil.restoring.restore import Restoration

DONE = StepRecord(
    "one",
    "Step | one",
    "listen to it",
    StepVerdict.DONE,
    "it is silent",
    outcome=StepOutcome(
        lines=["it said a", "- and b < c"],
        faults=["a unit is wrong"],
        pictures=["one.png"],
        quantities=[StatedFigure("inertia", 1.23456e-3, "kg m^2", 2e-5), StatedFigure("lag", 7.0, "us")],
        headline="it spoke",
    ),
)
FAILED = StepRecord("two", "Two", "", StepVerdict.FAILED, reason="it went wrong")
LEFT = StepRecord("three", "Three", "", StepVerdict.LEFT_OUT, reason="it has none")


def written(folder: Path, **result: Any) -> tuple[str, str]:
    """report.md and report.html."""
    (folder / "one.png").write_bytes(b"picture")
    request = CommissionRequest("hub:x", 5, folder)
    write_report(request, Commissioned(begun_at="then", **result))
    return (folder / "report.md").read_text(), (folder / "report.html").read_text()


def test_each_step_has_its_part_in_markdown(tmp_path: Path) -> None:
    text, _ = written(tmp_path, records=[DONE, FAILED, LEFT], error=NoAnswer("it is gone"))
    head, _, rest = text.partition("| step | result | |\n")
    verdict = "**NOT PASSED: it ended early; failed: Two**"
    begin = f"# Commissioning of node 5 on hub:x\n\n{verdict}\n\n**Ended early:** it is gone\n\n| | |\n"
    assert head.startswith(begin)
    assert rest == "\n".join(
        [
            "|---|---|---|",
            "| Step \\| one | done | it spoke |",
            "| Two | failed | it went wrong |",
            "| Three | left out | it has none |",
            "",
            "## Faults in the drive's settings",
            "",
            "- a unit is wrong",
            "",
            "## Left out",
            "",
            "- Three: left out, it has none",
            "",
            "## How the drive was left",
            "",
            "The drive was never enabled.",
            "Nothing was changed.",
            "",
            "## 1. Step | one",
            "",
            "*Listen to it.*",
            "",
            "It fails if it is silent.",
            "",
            "- it said a",
            "- and b < c",
            "- **found**: a unit is wrong",
            "",
            "![Step | one](one.png)",
            "",
            "## 2. Two",
            "",
            "**failed**: it went wrong",
            "",
            "## 3. Three",
            "",
            "**left out**: it has none",
            "",
        ]
    )


REST = {"enabled": True, "at_rest": True, "disabled": True}
AT_REST = "The drive is at rest and disabled."
UNDO = "hil restore {}/journal.jsonl"


@pytest.mark.parametrize(
    ("left", "settings", "sentences"),
    [
        ({}, "unchanged", ["The drive was never enabled.", "Nothing was changed."]),
        (
            {**REST, "stored": True},
            "stored",
            [
                AT_REST,
                "The settings were stored in the drive (1010h); the journal still holds what was there "
                "before.",
            ],
        ),
        (
            {**REST, "changed": 3, "not_stored": "refused"},
            "changed",
            [
                AT_REST,
                "The settings were NOT stored in the drive: refused. It keeps them until it is switched off; "
                f"`{UNDO}` puts back what was there before.",
            ],
        ),
        (
            {**REST, "changed": 3, "restoration": Restoration(3, 2)},
            "restored",
            [
                AT_REST,
                "All 3 objects that were written hold again, byte for byte, what they held before; each was "
                "read back.",
            ],
        ),
        (
            {**REST, "changed": 3, "restoration": Restoration(3, 2, ["6072h", "6080h"])},
            "changed",
            [AT_REST, f"Not all is as it was: 6072h; 6080h. `{UNDO}` tries again."],
        ),
        (
            {"enabled": True, "changed": 1, "evidence": "hub:x is gone", "host_watched": True},
            "changed",
            [
                "The drive is NOT confirmed at rest: hub:x is gone; it was set to stop by itself 150 ms "
                "after the host's last heartbeat.",
                f"1 object may hold other values than before: `{UNDO}` puts them back.",
            ],
        ),
        (
            {"enabled": True, "at_rest": True, "disabled": False, "evidence": "it does not answer"},
            "unchanged",
            [
                "The drive is at rest, but not confirmed disabled: it does not answer; it does not watch its "
                "host: stop it by its own emergency stop.",
                "Nothing was changed.",
            ],
        ),
    ],
)
def test_how_the_drive_was_left_is_told_in_both_reports_and_to_programs(
    tmp_path: Path, left: dict[str, Any], settings: str, sentences: list[str]
) -> None:
    text, page = written(tmp_path, left=DriveLeft(**left))
    undo = UNDO.format(tmp_path)
    lines = [sentence.replace(UNDO, undo) for sentence in sentences]
    assert text.split("## How the drive was left\n\n")[1] == "\n".join([*lines, ""])
    for line in lines:
        assert f"<li>{escape(line)}</li>" in page
    figures = json.loads((tmp_path / "figures.json").read_text())["left"]
    assert (figures["settings"], figures["text"]) == (settings, lines)
    assert (figures["at_rest"], figures["disabled"]) == (left.get("at_rest"), left.get("disabled"))
    assert figures["mend"] == (undo if settings == "changed" else None)


def test_each_step_has_its_part_in_one_html_file(tmp_path: Path) -> None:
    _, page = written(tmp_path, records=[DONE, FAILED])
    picture = base64.b64encode(b"picture").decode()
    steps = page[page.index("<h2>1.") :]
    assert steps == (
        "<h2>1. Step | one</h2><p><em>listen to it</em></p><p>It fails if it is silent.</p>"
        "<table><tr><th>quantity</th><th>value</th><th>of the fit, k = 2</th>"
        "<th>of the torque scale, k = 2</th><th>unit</th></tr>"
        "<tr><td>inertia</td><td>0.001235</td><td>2e-05</td><td></td><td>kg m^2</td></tr>"
        "<tr><td>lag</td><td>7</td><td></td><td></td><td>us</td></tr></table>"
        "<ul><li>it said a</li><li>and b &lt; c</li></ul>"
        f"<p><img alt='Step | one' src='data:image/png;base64,{picture}'></p>"
        "<h2>2. Two</h2><p class='failed'>failed: it went wrong</p></body></html>\n"
    )


def told_by(value: float, quantity: str) -> Stated:
    figure = ToldFigure(quantity, value, 7, "2000h:01", "x.toml", "")
    return Stated(value, str(figure), told=True)


@pytest.mark.parametrize("measured", [None, 0.5])
def test_whose_word_stands_for_what_nothing_measures(measured: float | None) -> None:
    """A torque constant only where none was measured."""
    findings = Findings(torque_constant_nm_a=measured)
    request = CommissionRequest("hub:x", 5, Path("out"))
    key = "not measurable over CiA 402"
    findings.stated = {"resistance_ohm": Stated(0.51234, BY_NAMEPLATE), "pole_pairs": Stated(4, BY_NAMEPLATE)}
    told = header_of(request, Commissioned(findings=findings))[key]
    assert told == "resistance, inductance, pole pairs: by the nameplate, or as said at the motor"
    findings.stated["torque_constant_nm_a"] = told_by(0.4, "torque_constant_nm_a")
    told = header_of(request, Commissioned(findings=findings))[key]
    constant = {"torque constant": "0.4 N m/A rms, told by the drive: object 2000h:01 = 7 (x.toml)"}
    assert told == {
        "resistance": "0.5123 ohm, by the nameplate",
        "pole pairs": "4, by the nameplate",
        **(constant if measured is None else {}),
    }


def test_what_was_written_is_told_in_the_order_of_the_objects(tmp_path: Path) -> None:
    limit, heartbeat = ObjectKey(0x6072, 0), ObjectKey(0x1017, 0)
    findings = Findings(settings={limit: b"\1\2", heartbeat: b"\x64\0"}, originals={limit: b"\xe8\3"})
    _, page = written(tmp_path, findings=findings)
    undo = f"hil restore {tmp_path / 'journal.jsonl'}"
    assert page[page.index("<h2>Written") :] == (
        "<h2>Written to the drive</h2><table>"
        "<tr><th>object</th><th>name</th><th>before</th><th>set</th></tr>"
        f"<tr><td>{heartbeat}</td><td>Producer heartbeat time</td><td></td><td>100</td></tr>"
        f"<tr><td>{limit}</td><td>Max torque</td><td>1000</td><td>513</td></tr></table>"
        f"<p>To undo: <code>{undo}</code></p></body></html>\n"
    )
    _, nothing = written(tmp_path)
    assert nothing.endswith("<h2>Written to the drive</h2><p>Nothing.</p></body></html>\n")


def test_what_was_written_is_told_in_the_units_of_the_drive(tmp_path: Path) -> None:
    """By its 6076h of 2 N m a torque limit is one in N m; programs have the bytes, too."""
    findings = Findings(
        settings={ObjectKey(0x6072, 0): b"\xf4\1"},
        originals={ObjectKey(0x6072, 0): b"\xe8\3"},
        dump={(0x6076, 0): (2000).to_bytes(4, "little")},
    )
    _, page = written(tmp_path, findings=findings)
    assert "<td>Max torque</td><td>2 N m (1000)</td><td>1 N m (500)</td>" in page
    (change,) = json.loads((tmp_path / "figures.json").read_text())["written"]
    assert (change["before"], change["set"], change["set_told"]) == ("e803", "f401", "1 N m (500)")


@pytest.mark.parametrize(
    ("result", "verdict"),
    [
        ({"left": DriveLeft(stored=True)}, "PASSED"),
        ({"left": DriveLeft(stored=True), "disturbances": ("a heartbeat",)}, "PASSED, DISTURBED"),
        ({"left": DriveLeft(stored=True), "records": [FAILED]}, "NOT PASSED: failed: Two"),
        ({"error": NoAnswer("it is gone")}, "NOT PASSED: it ended early"),
        (
            {"left": DriveLeft(not_stored="no 1010h")},
            "NOT PASSED: the drive is not left as it was found, nor stored",
        ),
    ],
)
def test_the_verdict_stands_first(tmp_path: Path, result: dict[str, Any], verdict: str) -> None:
    text, page = written(tmp_path, **result)
    assert text.splitlines()[2] == f"**{verdict}**"
    assert page.index(f">{verdict}</p>") < page.index("<table>")
    assert json.loads((tmp_path / "figures.json").read_text())["verdict"] == verdict


def test_counts_are_whole_numbers(tmp_path: Path) -> None:
    step = StepRecord("a", "A", "", StepVerdict.DONE, outcome=StepOutcome())
    step.outcome.measured("counts by a turn", 1048576.0, "")
    assert "<td>1048576</td>" in written(tmp_path, records=[step])[1]
