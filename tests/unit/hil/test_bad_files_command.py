"""Files that once ended a command in a traceback, or never: each ends it with 2 and says why."""

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.verdict.verdict import ExitStatus

EXAMPLES = Path(__file__).parents[3] / "examples"
BENCH = str(EXAMPLES / "ling2012.toml")
DEEP = "[" * 3000
FAULT_PLANS = {
    "times": "[[blackout]]\nfrom_s = 1e308\nduration_s = 1e308\n",
    "delay": "[[delay]]\ndelay_us = 1e308\n",
    "drift": "[[clock_drift]]\ndrift_ppm = 1e308\n",
    "probability": "[[loss]]\nprobability = 1" + "0" * 400 + "\n",
    "probability_64": f"[[loss]]\nprobability = {2**63 - 1}\n",
    "histogram": "[[measured_delay]]\nedges_us = [0, 1e308]\ncounts = [1]\n",
    "deep": f"a = {DEEP}",
    "digits": f"[[periodic_loss]]\nlost = {'9' * 4301}\n",
    "key": "k" * 100_000 + " = 1\n",
    "dotted": "k." * 50_000 + "k = 1\n",
    "terminal": '"\\u001b[2J" = 1\n',
}


def refused(*arguments: str) -> str:
    """What the command says; it must end as for bad input."""
    found = CliRunner().invoke(app, list(arguments))
    assert found.exit_code == ExitStatus.BAD_INPUT, found.output[-2000:]
    assert "Traceback" not in found.stderr
    assert found.stderr.replace("\n", "").isprintable()
    return found.stderr


@pytest.mark.parametrize("name", FAULT_PLANS)
def test_a_fault_plan_ends_with_bad_input(tmp_path: Path, name: str) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(FAULT_PLANS[name])
    bench = tmp_path / "bench.toml"
    text = Path(BENCH).read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    bench.write_text(text.replace('"faults/demo.toml"', '"plan.toml"'))
    assert "plan.toml" in refused("run", str(bench))


@pytest.mark.parametrize(
    "command",
    [
        ("run", "{}"),
        ("run", BENCH, "--replay-faults", "{}"),
        ("run", BENCH, "--network", "{}"),
        ("simulate", "--bus", "hub:x", "--node", "1", "--motor", "{}"),
        ("simulate", "--bus", "hub:x", "--node", "1", "--faults", "{}"),
        ("simulate", "--bus", "hub:x", "--node", "1", "--eds", "{}"),
        ("simulate", "--bus", "hub:x", "--node", "1", "--store", "{}"),
        ("simulate", "--bus", "hub:x", "--node", "1", "--background", "{}"),
        ("simulate", "--bus", "hub:x", "--node", "1", "--current-control", "{}"),
        ("eds", "{}"),
        ("design", "hinf", "{}"),
        ("design", "current", "{}"),
        ("design", "current", str(EXAMPLES / "motors" / "azaiz2007.toml"), "--weights", "{}"),
        ("analyse", "speed", "{}", "--gain", "0,-0.02", "--delay-ms", "64"),
        ("restore", "{}"),
        ("commission", "--bus", "hub:x", "--node", "1", "--out", "/nowhere", "--motor", "{}"),
    ],
    ids=lambda command: " ".join(part for part in command if "/" not in part),
)
def test_what_is_no_regular_file_ends_with_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    runtime = tmp_path / "run"
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    suffix = ".jsonl" if "--replay-faults" in command else ".toml"
    os.mkfifo(tmp_path / f"fifo{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    for name in ("fifo", "folder", "zero"):
        refused(*(part.format(tmp_path / f"{name}{suffix}") if part == "{}" else part for part in command))


def test_deep_lines_of_recorded_faults_end_with_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "faults.jsonl"
    for line in (DEEP, '{"kind": ' * 400, '{"at_ns": ' + "9" * 4000 + "}"):
        path.write_text(line + "\n")
        assert "line 1" in refused("run", BENCH, "--replay-faults", str(path))


@pytest.mark.parametrize(
    "spec", ["hub:a/b", "hub:-x", "slcan:/dev/ttyACM0@" + "9" * 5000], ids=["slash", "dash", "baud"]
)
def test_a_bus_that_cannot_be_ends_with_bad_input(spec: str) -> None:
    assert "--bus" in refused("run", BENCH, "--bus", spec)
