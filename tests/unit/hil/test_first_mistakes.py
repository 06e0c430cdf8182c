"""What a new user gives a command by mistake is answered by what it is, and what was expected."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``hil init`` writes."""
    folder = tmp_path_factory.mktemp("first")
    assert CliRunner().invoke(app, ["init", str(folder)]).exit_code == 0
    return folder


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("bench.toml", "A bench file is run by: hil run bench.toml"),
        ("run", "Missing argument 'BENCH.toml'. Expected: The bench file."),
        ("run controller.py", "found 'a Python file', expected a bench file"),
        ("run controller.py", "--controller AXIS=controller.py:CLASS"),
        (
            "run bench.toml --no-record --controller axis1=controller.py",
            "expected the class too: axis1=controller.py:NAME",
        ),
        ("simulate --bus hub:x --node 1 --faults bench.toml", "found 'a bench file', expected a fault plan"),
        ("view bench.toml", "bench.toml: found 'a file', expected the folder of a recording"),
        ("trace .", "found 'no records.arrow', expected the folder of a recording"),
        ("review bench.toml", "bench.toml: found 'a file', expected the folder of a recording"),
        (
            "restore bench.toml",
            "bench.toml: found 'a TOML file', expected journal.jsonl, which hil commission",
        ),
        ("commission --bus hub:x", "Missing option '--node'. Expected: The drive's node id."),
        (
            "commission --bus hub:x --node 1 --out c --motor motor.toml",
            "motor.toml: found 'a motor file', expected a nameplate file",
        ),
        (
            "motor show bench.toml",
            "found 'a bench file', expected a file with [mechanics], [motor], [rating]",
        ),
        ("motor show controller.py", "controller.py: found 'a Python file', expected a motor file, in TOML"),
        ("verify controller.py", "controller.py: found 'a Python file', expected a controller file, in TOML"),
        ("simulate --bus hub:x --node 1 --load 1=no.csv", "--load: Signal file not found: no.csv"),
        ("analyse speed motor.toml", "Missing option '--gain'. Expected: Gain on [i_q error"),
    ],
)
def test_a_mistake_is_told_with_what_was_expected(
    typed: str, told: str, first: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(first)
    done = CliRunner().invoke(app, typed.split(), env={"COLUMNS": "200"})
    assert (done.exit_code, told in done.output) == (2, True), done.output


@pytest.mark.parametrize(
    ("written", "instead", "told"),
    [
        (
            "[[reference.axis1]]",
            "[reference.axis1]",
            "reference.axis1: found 'a table of 4 keys', expected tables, each headed [[reference.axis1]]",
        ),
        (
            "[[load.axis1]]",
            "[load]",
            "load.torque_nm: found 0.5, expected tables, each headed [[load.NAME]]",
        ),
        ("[drive.axis1]", "[drive]", "drive.node: found 1, expected a table headed [drive.NAME]"),
        (
            "[drive.axis1.limits]",
            "[limits]",
            "no such key here; it stands in [drive.NAME] or [drive.NAME.commissioned]",
        ),
        (
            "[bench]",
            "[bench]\ndeadline_us = 700",
            "bench.deadline_us: found 700, expected no such key here; it stands in [loop]",
        ),
        (
            "[verdict]",
            "[loop]\nfrequency_hz = 1000\n[verdict]",
            "loop.frequency_hz: found 1000, expected period_us, a period; write period_us = 1000",
        ),
        (
            'kind = "ramp"\nspeed_rpm = 2000.0\nover_s = 0.2',
            'kind = "file"\npath = "motion.csv"',
            "reference.axis1[0].path: Signal file not found: motion.csv",
        ),
        (
            "bandwidth_rad_s = 150.0",
            "bandwith_rad_s = 150.0",
            "parameters.bandwith_rad_s: found 150.0, expected bandwidth_rad_s, the nearest known key",
        ),
        (
            "bandwidth_rad_s = 150.0",
            'bandwidth_rad_s = "fast"',
            "controller.py:12: TypeError: can't multiply sequence by non-int of type 'float'",
        ),
        ("torque_max_nm = 3.0", "torque_max_nm = 30.0", "what the motor first gives at 12 A"),
    ],
)
def test_a_slip_in_the_first_bench_is_told_with_its_cure(
    written: str, instead: str, told: str, first: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(first)
    text = Path("bench.toml").read_text(encoding="utf-8")
    assert written in text
    Path("slip.toml").write_text(text.replace(written, instead), encoding="utf-8")
    done = CliRunner().invoke(app, ["run", "slip.toml", "--no-record"])
    assert (done.exit_code, told in done.output) == (2, True), done.output
