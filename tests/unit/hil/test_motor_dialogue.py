"""``hil motor new`` at a terminal, question by question, and what ``hil motor show`` prints and draws."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from servobench.design.motor import motor_figures
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.studies.motor.figures import FIGURES, GROUPS
from tests.picture_text import drawn
from tests.unit.hil.test_motor_command import SHEET

MISSING = ("--poles", "--r-line-ohm", "--dc-bus-v")


def new(path: Path, without: tuple[str, ...], *more: str, text: str = "") -> Result:
    words = [str(word) for pair in SHEET.items() if pair[0] not in without for word in pair]
    return CliRunner().invoke(app, ["motor", "new", str(path), *words, *more], input=text)


def show(*arguments: str | Path) -> Result:
    return CliRunner(env={"COLUMNS": "80"}).invoke(app, ["motor", "show", *map(str, arguments)])


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servobench.hil.terminal.motor.at_terminal", lambda: True)


@pytest.fixture
def motor(tmp_path: Path) -> Path:
    path = tmp_path / "a.toml"
    assert new(path, ()).exit_code == 0
    return path


@pytest.mark.usefixtures("terminal")
def test_each_question_lists_the_ways_in_which_a_sheet_answers_it(tmp_path: Path) -> None:
    """Of the only way no number is asked."""
    done = new(tmp_path / "a.toml", MISSING, text="2\n5\n1\n1.8 ohm\n325\n")
    assert done.exit_code == 0, done.output
    questions = []
    for group, answers in (("poles", ("2", "5")), ("resistance", ("1", "1.8 ohm")), ("bus", ("325",))):
        ways = [figure for figure in FIGURES if figure.group == group]
        questions.append(GROUPS[group].question)
        questions += [f"  {number}  {figure.text}" for number, figure in enumerate(ways, 1)]
        if len(answers) > 1:
            questions.append(f"  as the sheet has it: {answers[0]}")
        questions.append(f"  {ways[int(answers[0]) - 1 if len(answers) > 1 else 0].text}: {answers[-1]}")
    assert done.stdout.splitlines() == questions
    assert done.stderr == f"written {tmp_path / 'a.toml'}\n"


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("answer", [0, 3, -1])
def test_an_answer_that_is_none_of_the_ways_is_refused(tmp_path: Path, answer: int) -> None:
    done = new(tmp_path / "a.toml", ("--poles",), text=f"{answer}\n")
    refusal = f"hil: error: answer: How many poles: found {answer}, expected 1 to 2\n"
    assert (done.exit_code, done.stderr) == (2, refusal)
    assert not (tmp_path / "a.toml").exists()


@pytest.mark.usefixtures("terminal")
def test_a_figure_that_is_none_is_asked_for_again(tmp_path: Path) -> None:
    done = new(tmp_path / "a.toml", ("--dc-bus-v",), text="many\n-3 kg\n325\n")
    assert done.exit_code == 0, done.output
    assert done.stdout.count("Voltage of the inverter's DC bus") == 1
    assert load_motor(tmp_path / "a.toml").parameters.dc_bus_voltage_v == 325.0


def test_a_file_that_is_there_is_refused_by_name(motor: Path) -> None:
    done = new(motor, ())
    expected = (
        f"hil: error: MOTOR.toml: found {str(motor)!r}, expected a file that is not there yet; or --force\n"
    )
    assert (done.exit_code, done.stderr, done.stdout) == (2, expected, "")


def test_phases_are_in_star_and_the_name_is_that_of_the_file(tmp_path: Path) -> None:
    """1.8 ohm a phase: 1.8 ohm in star, a third of it in delta; both as an equivalent star."""
    values = {}
    for name, more in (("star", ()), ("asked", ("--star",)), ("delta", ("--delta",))):
        path = tmp_path / f"{name}.toml"
        done = new(path, ("--r-line-ohm",), "--r-phase-ohm", "1.8", *more)
        assert done.exit_code == 0, done.output
        parameters = load_motor(path).parameters
        assert parameters.name == name
        values[name] = parameters.resistance_ohm
    assert values == pytest.approx({"star": 1.8, "asked": 1.8, "delta": 0.6})


def test_figures_of_a_motor_are_a_table_or_one_object(motor: Path) -> None:
    parameters = load_motor(motor).parameters
    figures = {"name": parameters.name, **motor_figures(parameters)}
    assert json.loads(show(motor, "--json").stdout) == figures
    lines = show(motor).stdout.splitlines()
    assert [line.split() for line in lines] == [
        ["figure", "value"],
        *([key, value if isinstance(value, str) else f"{value:.5g}"] for key, value in figures.items()),
    ]
    assert len({len(line.rstrip()) for line in lines}) == 1


def test_the_picture_has_torque_over_speed_with_the_rated_point(motor: Path, tmp_path: Path) -> None:
    with drawn() as pictures:
        done = show(motor, "--picture", tmp_path / "a.png")
    assert (done.exit_code, done.stderr) == (0, f"written {tmp_path / 'a.png'}\n")
    (text,) = pictures
    for part in ("speed, r/min", "torque, N m", "peak, i_d = 0", "rated torque", "rated point"):
        assert part in text
    assert load_motor(motor).parameters.name in text


@pytest.mark.parametrize("name", ["a.nothing", "none/a.png"])
def test_a_picture_that_cannot_be_written_is_refused(motor: Path, tmp_path: Path, name: str) -> None:
    done = show(motor, "--picture", tmp_path / name)
    expected = "a .png, .svg or .pdf file that can be written ("
    refusal = f"hil: error: --picture: found {str(tmp_path / name)!r}, expected {expected}"
    assert done.exit_code == 2
    assert done.stderr.startswith(refusal)
