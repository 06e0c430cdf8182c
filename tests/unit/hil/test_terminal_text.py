"""What commands print, line by line: figures by name, advice, how far a campaign is."""

import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from servobench.drivers.errors import BadInput, BenchError
from servobench.drivers.written_file import writing
from servobench.hil.campaign.campaign import CampaignProgress
from servobench.hil.terminal.campaign import _duration, _ProgressLine
from servobench.hil.terminal.commands import error_text
from servobench.hil.terminal.current_report import advice, print_current, root_text
from servobench.hil.terminal.output import columns, figure_text, on_terminal, print_figures, titled

Capture = pytest.CaptureFixture[str]


def test_figures_are_printed_by_name_tables_inside_one_another(capsys: Capture) -> None:
    figures: dict[str, Any] = {
        "gain": [1.23456789, 2],
        "none": None,
        "stable": True,
        "name": "a b",
        "empty": [],
        "inner": {"wrong": False, "deep": {"n": 12345678}},
        "rows": [{"a": 0.5, "b": None}, {"a": 3}],
    }
    print_figures(figures)
    assert capsys.readouterr().out == (
        "gain                       1.234568  2\n"
        "none                       -\n"
        "stable                     yes\n"
        "name                       a b\n"
        "empty                      \n"
        "inner\n"
        "  wrong                      no\n"
        "  deep\n"
        "    n                          12345678\n"
        "rows\n"
        "  a 0.5   b -\n"
        "  a 3\n"
    )
    print_figures(
        {"a": 1, "b": {"c": [{"d": 2, "e": 3}]}}, "> ", text=lambda value: f"<{value}>", width=3, gap="/"
    )
    assert capsys.readouterr().out == "> a   <1>\n> b\n>   c\n>     d <2>/e <3>\n"


def test_figures_of_a_current_loop_have_roots_and_six_digits(capsys: Capture) -> None:
    print_current({"gain": 1.23456789, "poles": [[-1.5, 0.0], [-2.0, 3.25]], "order": 4, "structure": None})
    assert capsys.readouterr().out == (
        "gain                         1.23457\n"
        "poles                        -1.5  -2+3.25j\n"
        "order                        4\n"
        "structure                    None\n"
    )
    assert [root_text(root) for root in ([0.0, -0.5], [1234567.0, 0.0])] == ["0-0.5j", "1.23457e+06"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (True, "yes"), (False, "no"), (1.0, "1"), (12345678.9, "1.234568e+07"), (0, "0")],
)
def test_a_figure_as_text(value: Any, text: str) -> None:
    assert figure_text(value) == text


COUPLED = {"speed_rad_s": 314.159, "certified": True, "stable_up_to_percent": 12.3456}
DESIGN: dict[str, Any] = {
    "closed_loop_norm": 0.98765,
    "gamma": 1.0,
    "gamma_min": 0.9,
    "structure": "full",
    "robust": {"coupled": COUPLED},
}
STAYS = "Both axes stay stable at 314.2 rad/s over +-50 % of r, L_d and L_q."
LOWEST = {"rate_hz": 7999.6, "modulus_margin": 0.54321}
SPEEDS = {"speed_rad_s": [10.0, 20.0, 30.0], "decoupled": [0.9, 0.99, 0.5], "as_asked": [0.9, 1.0, 1.1]}
RATE = "An inner rate of 8000 Hz or more holds a modulus margin of 0.543 and keeps both axes stable at speed."


@pytest.mark.parametrize(
    ("changes", "lines"),
    [
        ({}, [STAYS]),
        ({"closed_loop_norm": 1.0}, [STAYS]),
        ({"closed_loop_norm": 1.00012}, ["The norm 1 is above gamma 1.", STAYS]),
        (
            {"structure": "pi", "closed_loop_norm": 1.23456},
            ["The structure pi reaches a norm of 1.235; gamma_min of the full order is 0.9.", STAYS],
        ),
        (
            {"robust": {"coupled": COUPLED | {"certified": False}}},
            [
                "At 314.2 rad/s both axes are certain to stay stable for +-12.3 % of r, L_d and L_q only, "
                "because the drive decouples with the nominal inductances."
            ],
        ),
        (
            {"sampled": {"rate_hz": 8000.0, "lowest_rate": LOWEST, "coupled": SPEEDS}},
            [STAYS, RATE, "At 8000 Hz, as_asked: unstable from 20 rad/s on."],
        ),
        (
            {
                "sampled": {
                    "rate_hz": 12345.0,
                    "lowest_rate": LOWEST | {"rate_hz": None},
                    "coupled": {"speed_rad_s": [10.0, 2.0], "decoupled": [1.5, 1.0]},
                }
            },
            [
                STAYS,
                "No inner rate keeps both axes stable at that speed.",
                "At 12345 Hz, decoupled: unstable from 2 rad/s on.",
            ],
        ),
    ],
)
def test_advice_about_a_current_loop(changes: dict[str, Any], lines: list[str]) -> None:
    assert advice(DESIGN | changes) == lines


# ---- how far a campaign is ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 0 s"),
        (61.0, "1 min 1 s"),
        (3599.0, "59 min 59 s"),
        (3600.0, "1 h 0 min"),
        (90061.0, "25 h 1 min"),
    ],
)
def test_a_duration_in_words(seconds: float, text: str) -> None:
    assert _duration(seconds) == text


def progress(done: int, planned: int = 400) -> CampaignProgress:
    return CampaignProgress(done, planned, done // 2, 12.345, 61.0)


def test_into_a_file_a_campaign_tells_each_percent_once(capsys: Capture) -> None:
    line = _ProgressLine()
    for done in (0, 3, 4, 7, 400):
        line.show(progress(done))
    line.end()
    rest = "passed  12.3/s  1 min 1 s left at most"
    assert capsys.readouterr().err.splitlines() == [
        f"0/400 runs  0 {rest}",
        f"4/400 runs  2 {rest}",
        f"400/400 runs  200 {rest}",
        "12.3 runs a second",
    ]
    _ProgressLine().end()
    assert capsys.readouterr().err == ""


def test_on_a_terminal_a_campaign_has_one_line(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    line = _ProgressLine()
    line.show(progress(3))
    line.show(progress(3))
    text = "3/400 runs  1 passed  12.3/s  1 min 1 s left at most"
    assert capsys.readouterr().err == f"\r{text:<78}" * 2
    line.end()
    assert capsys.readouterr().err == "\n12.3 runs a second\n"
    on_terminal("being done")
    assert capsys.readouterr().err == "being done\n"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    on_terminal("being done")
    _ProgressLine().end()
    assert capsys.readouterr().err == ""


# ---- tables and errors --------------------------------------------------------------------------------


def shown(*parts: Any) -> list[str]:
    console = Console(width=60, color_system=None)
    with console.capture() as capture:
        console.print(*parts)
    return [line.rstrip() for line in capture.get().splitlines()]


def test_columns_of_figures_end_alike() -> None:
    table = columns("name", "value", right=("value",))
    table.add_row("a", "1.5")
    table.add_row("longer", "12345.5")
    assert shown(table) == ["name      value", "a           1.5", "longer  12345.5"]
    bare = columns()
    bare.add_row("a", "b")
    assert shown(bare) == ["a  b"]


def test_a_line_behind_its_title_is_no_markup() -> None:
    assert shown(titled({"File": "[bold]a[/bold].eds", "Modes": "none"})) == [
        "File   [bold]a[/bold].eds", "Modes  none"
    ]  # fmt: skip


def test_errors_are_one_line_each() -> None:
    assert error_text(BenchError("a\tb")) == "hil: error: a\\tb"
    assert error_text(BenchError("one\ntwo\x1b[2J")) == "hil: 2 errors:\n  one\n  two\\x1b[2J"


@pytest.mark.parametrize(
    ("error", "reason"), [(OSError(13, "Permission denied"), "Permission denied"), (OSError("odd"), "odd")]
)
def test_a_place_that_cannot_be_written_to_is_bad_input(error: OSError, reason: str) -> None:
    with pytest.raises(BadInput) as caught, writing("--rrd", Path("a/b.rrd")):
        raise error
    assert str(caught.value) == f"--rrd: found 'a/b.rrd', expected a place to write to; {reason}"
