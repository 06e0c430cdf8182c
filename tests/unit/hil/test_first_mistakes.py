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
        ("analyse speed motor.toml", "Missing option '--gain'. Expected: Gain on [i_q error"),
    ],
)
def test_a_mistake_is_told_with_what_was_expected(
    typed: str, told: str, first: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(first)
    done = CliRunner().invoke(app, typed.split(), env={"COLUMNS": "200"})
    assert (done.exit_code, told in done.output) == (2, True), done.output
