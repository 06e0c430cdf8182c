"""``hil reproduce``: figures made up here, and where each of them stands in what is printed and written."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from typer.testing import CliRunner, Result

from servobench.design.motor import PmsmParameters
from servobench.design.papers import azaiz2007, ling2012
from servobench.drivers import timebase
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.studies.current import pictures as current_pictures
from servobench.hil.studies.papers import pictures, reproduction
from tests.told import ROOT

MOTOR = ROOT / "examples" / "motors" / "ling2012.toml"
ROW = {
    "error_percent": 2.5, "gamma": 0.123456, "published_delay_s": 0.0821, "ccl_delay_s": 0.07304,
    "lmi_delay_s": None, "exact_speed_feedback_delay_s": 0.075119, "exact_delay_s": 0.1,
    "gain": [0.00123456, -0.0212],
}  # fmt: skip
SHOWN = ["2.5", "0.12346", "82.1", "73.04", "-", "75.12", "100", "0.001235, -0.0212"]
HEADINGS = ["error, %", "gamma", "printed", "CCL", "LMI", "exact, speed only", "exact, full", "K, full"]


def hil(*arguments: str | Path) -> Result:
    result = CliRunner(env={"COLUMNS": "160"}).invoke(app, ["reproduce", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result


def cells(text: str) -> list[list[str]]:
    """Of the lines of tables, heads included."""
    rows = [line.replace("┃", "│") for line in text.splitlines() if line[:1] in "│┃"]
    return [[cell.strip() for cell in row.strip("│").split("│")] for row in rows if row]


# ---- [Ling2012] ---------------------------------------------------------------------------------------

RESULTS: dict[str, Any] = {
    "table2": {"published": [ROW, ROW | {"lmi_delay_s": 0.0601}], "si": [ROW]},
    "published_design": {"gain": [0.0, -0.0212], "delay_s": 0.064, "stable": True},
    "case1": {"published": {"overshoot_percent": 20.123456789}, "bench": {"stamp": {"settled": False}}},
    "case2": {"better": "robust"},
    "case3": {"recovery_s": None},
    "strategies": {"stamp": {"sequences": 3, "age_max_s": 0.06, "gamma": 7.0}},
}
SECTIONS = """Controller of section 5
  gain                       0  -0.0212
  delay_s                    0.064
  stable                     yes
Case 1
  published
    overshoot_percent          20.12346
  bench
    stamp
      settled                    no
Case 2
  better                     robust
Case 3
  recovery_s                 -
Strategies on 10 ms, 5 losses in a row, 4 ms of delay, K as printed
  stamp
    sequences                  3
    age_max_s                  0.06
"""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What was handed over to the studies; they take no time."""
    kept: dict[str, Any] = {}

    def reproduce(runs: Path, tell: Any) -> tuple[dict[str, Any], list[str]]:
        tell("case 1 on the bench")
        kept["runs"] = runs
        return RESULTS, ["a run"]

    def draw(results: Any, recorded: Any, folder: Path) -> list[Path]:
        kept["drawn"] = results, recorded, folder
        return [folder / "one.png", folder / "two.png"]

    monkeypatch.setattr(reproduction, "reproduce", reproduce)
    monkeypatch.setattr(pictures, "draw_ling2012", draw)
    monkeypatch.setattr(timebase, "utc_stamp", lambda: "DATE")
    return kept


def test_the_figures_of_ling_stand_by_section(asked: dict[str, Any]) -> None:
    result = hil("ling2012")
    assert cells(result.stdout) == [HEADINGS, SHOWN, [*SHOWN[:4], "60.1", *SHOWN[5:]], HEADINGS, SHOWN]
    lines = [line.rstrip() for line in result.stdout.splitlines() if line.startswith("Table 2")]
    assert lines == ["Table 2 in the paper's units: largest delay, ms", "Table 2 in SI: largest delay, ms"]
    rest = result.stdout[result.stdout.index("Controller of section 5") :]
    assert rest.startswith(SECTIONS)
    remarks = rest.removeprefix(SECTIONS)
    told = "".join(f"* {text}" for text in ling2012.DISAGREEMENTS)
    assert remarks.replace("\n", "").replace(" ", "") == told.replace("\n", "").replace(" ", "")
    assert result.stderr == "case 1 on the bench\n"
    assert asked == {"runs": Path("runs/ling2012-DATE")}


def test_pictures_and_runs_of_ling_are_in_the_folder_of_the_figures(
    asked: dict[str, Any], tmp_path: Path
) -> None:
    result = hil("ling2012", "--figures", tmp_path, "--json")
    assert json.loads(result.stdout) == RESULTS
    assert asked == {"runs": tmp_path / "ling2012-DATE", "drawn": (RESULTS, ["a run"], tmp_path)}
    pictured = f"written {tmp_path / 'one.png'}\nwritten {tmp_path / 'two.png'}\n"
    assert result.stderr == f"case 1 on the bench\n{pictured}"


OTHER: dict[str, Any] = {
    "motor": "other",
    "load_nm": 1.25678,
    "speed_rpm": 3000.456,
    "rows": [
        {key: value for key, value in ROW.items() if key != "published_delay_s"},
        {"error_percent": 1.5, "gamma": 0.1, "impossible": "no gain keeps it"},
    ],
}


@pytest.mark.parametrize("drawn", [False, True])
def test_table_2_for_another_motor_has_no_printed_column(drawn: bool, tmp_path: Path) -> None:
    motors: list[str] = []
    drawings: list[tuple[Any, Path]] = []
    folder = tmp_path / "new" / "folder"

    def for_motor(motor: PmsmParameters) -> dict[str, Any]:
        motors.append(motor.name)
        return OTHER

    with (
        patch.object(reproduction, "for_motor", for_motor),
        patch.object(pictures, "draw_motor", lambda figures, path: drawings.append((figures, path))),
    ):
        result = hil("ling2012", "--motor", MOTOR, *(("--figures", folder) if drawn else ()))
        assert json.loads(hil("ling2012", "--motor", MOTOR, "--json").stdout) == OTHER
    assert cells(result.stdout) == [[*HEADINGS[:2], *HEADINGS[3:]], [*SHOWN[:2], *SHOWN[3:]]]
    lines = [line.rstrip() for line in result.stdout.splitlines()]
    title = "Table 2 for other, load step of 1.257 N m at 3000.5 r/min: largest delay, ms"
    assert (lines[0], lines[-1]) == (title, "* 1.5 %: no gain keeps it")
    assert motors == [load_motor(MOTOR).parameters.name] * 2
    picture = folder / "ling2012-table2.png"
    assert (drawings, folder.is_dir()) == ([(OTHER, picture)] if drawn else [], drawn)
    assert result.stderr == (f"written {picture}\n" if drawn else "")


# ---- [Azaiz2007] --------------------------------------------------------------------------------------

AXIS = {
    "gain": 49.7026041,
    "zeros": [[-214.285714, 0.0], [-2396.577097, 600.349506]],
    "gamma_min": 0.951760846,
    "overshoot_percent": 0.0,
    "hankel_singular_values": [3708.7238, 0.2097670],
    "order": 4,
    "reduced": {"order": 2.0, "poles": [[-1.5, -2.5]]},
}
PRINTED = {
    "gain": 49.7123456,
    "zeros": [[-200.0, 0.0]],
    "overshoot_percent": 0.125,
    "hankel_singular_values": [1.0],
}
RUN = {"peak_torque_nm": 11.327487, "id_max_a": 0.0}
FIGURES = {
    "q": AXIS,
    "d": AXIS | {"gain": 2.5},
    "simulation": {"nominal": RUN, "time_constants_plus_50": RUN | {"id_max_a": 0.5}},
}
PUBLISHED: dict[str, dict[str, float]] = {
    "q": {"gain": 49.7, "overshoot_percent": 0.0}, "d": {}, "simulation": {"peak_torque_nm": 14.3},
}  # fmt: skip


def test_the_figures_of_azaiz_stand_beside_the_published_and_the_printed_ones(tmp_path: Path) -> None:
    drawings: list[Any] = []

    def draw(designs: Any, runs: Any, folder: Path) -> list[Path]:
        drawings.append((designs, runs, folder))
        return [folder / "fig07.png"]

    with (
        patch.object(azaiz2007, "reproduce", lambda: (FIGURES, "designs", "runs")),
        patch.object(azaiz2007, "printed_figures", lambda _axis: PRINTED),
        patch.object(azaiz2007, "PUBLISHED", PUBLISHED),
        patch.object(azaiz2007, "DISAGREEMENTS", ("one thing", "another")),
        patch.object(current_pictures, "draw_paper", draw),
    ):
        result = hil("azaiz2007")
        assert (drawings, result.stderr) == ([], "")
        told = hil("azaiz2007", "--figures", tmp_path, "--json")
    assert json.loads(told.stdout) == FIGURES
    assert (drawings, told.stderr) == (
        [("designs", "runs", tmp_path)], f"written {tmp_path / 'fig07.png'}\n"
    )  # fmt: skip

    def of_axis(gain: str, published: str, overshoot: str) -> list[list[str]]:
        return [
            ["figure", "published", "printed K", "here"],
            ["gain", published, "49.7123", gain],
            ["zeros", "", "-200", "-214.286"],
            ["", "", "", "-2396.58+600.35j"],
            ["gamma_min", "", "", "0.951761"],
            ["overshoot_percent", overshoot, "0.125", "0"],
            ["hankel_singular_values", "", "1", "3708.7"],
            ["", "", "", "0.20977"],
            ["reduced order", "", "", "2"],
            ["reduced poles", "", "", "-1.5-2.5j"],
        ]

    assert cells(result.stdout) == [
        *of_axis("49.7026", "49.7", "0"),
        *of_axis("2.5", "", ""),
        ["figure", "nominal", "time constants plus 50"],
        ["peak_torque_nm", "11.327", "11.327"],
        ["id_max_a", "0", "0.5"],
    ]
    lines = [line.strip() for line in result.stdout.splitlines()]
    titles = [line for line in lines if line.startswith(("K_", "The drive"))]
    assert titles == ["K_q", "K_d", "The drive of Fig. 4 (published peak torque: 14.3 N m)"]
    assert lines[-2:] == ["* one thing", "* another"]


# ---- places -------------------------------------------------------------------------------------------


def test_pictures_of_a_motor_that_have_no_place_are_refused(tmp_path: Path) -> None:
    """Below a file there is no folder; and a picture's own name may be taken by one."""
    taken = tmp_path / "taken"
    taken.touch()
    (tmp_path / "ling2012-table2.png").mkdir()
    figures = OTHER | {"rows": [row for row in OTHER["rows"] if "impossible" not in row]}
    with patch.object(reproduction, "for_motor", lambda _motor: figures):
        told = {
            place: CliRunner().invoke(
                app, ["reproduce", "ling2012", "--motor", str(MOTOR), "--figures", str(place)]
            )
            for place in (taken, taken / "below", tmp_path)
        }
    assert {place: (result.exit_code, result.stdout) for place, result in told.items()} == dict.fromkeys(
        told, (2, "")
    )
    refused = "hil: error: --figures: found '{}', expected a folder ({})\n"
    assert told[taken].stderr == refused.format(taken, "File exists")
    assert told[taken / "below"].stderr == refused.format(taken / "below", "Not a directory")
    picture = tmp_path / "ling2012-table2.png"
    assert told[tmp_path].stderr == (
        f"hil: error: --figures: found '{picture}', expected a .png, .svg or .pdf file that can be written "
        f"([Errno 21] Is a directory: '{picture}')\n"
    )
