"""Mutated files and options through the command line: it ends soon, with a status that is documented."""

from pathlib import Path
from typing import Final

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from tests.draws import ALL
from tests.mutants.kinds import EXAMPLES, KINDS
from tests.mutants.mutant import INSERTS, NUMBERS, PROCESSOR_S_MAX, Kind, mutant, processor_s
from tests.mutants.recordings import recording_kinds, write_unfinished

BENCH: Final = str(EXAMPLES / "ling2012.toml")
MUTANTS: Final = 26 if ALL else 8
"""Of each command: over 500 together, a third of them in ``make test``."""
MUTANTS_RECORDED: Final = 2
"""Of each file of a recording: to recover it takes a quarter of a second."""
NOWHERE: Final = "hub:a/b"
"""No bus: commands that have read their files end there with 2."""
FILES: Final[dict[str, list[tuple[str, ...]]]] = {
    "bench.toml": [("run", "{}", "--record", "{occupied}")],
    "faults.jsonl": [("run", BENCH, "--record", "{occupied}", "--replay-faults", "{}")],
    "network.toml": [("run", BENCH, "--record", "{occupied}", "--network", "{}")],
    "plan.toml": [("measure", "--bus", NOWHERE, "--node", "1", "--faults", "{}")],
    "clocks.toml": [("measure", "--bus", NOWHERE, "--node", "1", "--faults", "{}")],
    "motor.toml": [("measure", "--bus", NOWHERE, "--node", "1", "--motor", "{}")],
    "background.toml": [("simulate", "--bus", NOWHERE, "--node", "1", "--background", "{}")],
    "store.json": [("simulate", "--bus", NOWHERE, "--node", "1", "--store", "{}")],
    "current.toml": [("simulate", "--bus", NOWHERE, "--node", "1", "--current-control", "{}")],
    "plate.toml": [("commission", "--bus", NOWHERE, "--node", "1", "--out", "{out}", "--motor", "{}")],
    "journal.jsonl": [("restore", "--bus", NOWHERE, "{}")],
    "sound.eds": [("eds", "{}", "--json"), ("eds", "{}", "--plan")],
    "configured.dcf": [("eds", "{}")],
}
OPTIONS: Final = [
    ("run", BENCH, "--record", "{occupied}", "--seed", "{}"),
    ("run", BENCH, "--record", "{occupied}", "--bus", "{}"),
    ("measure", "--bus", NOWHERE, "--node", "{}"),
    ("measure", "--bus", NOWHERE, "--node", "1", "--torque-max-nm", "{}"),
    ("measure", "--bus", NOWHERE, "--node", "1", "--period-us", "{}"),
]
FAILED_AND_TOLD: Final = (0, 1, 2, 3, 5)
"""docs/exit-status.md; of these commands none may run into a defect, 70."""


def command(arguments: tuple[str, ...], mutated: str, folder: Path) -> str:
    """What is wrong with how a command ended; empty if nothing is."""
    named = [
        part.format(mutated, occupied=folder / "occupied", out=folder / "out") if "{" in part else part
        for part in arguments
    ]
    begun = processor_s()
    ended = CliRunner().invoke(app, named)
    took_s = processor_s() - begun
    if ended.exit_code not in FAILED_AND_TOLD or "Traceback" in ended.output:
        return f"{arguments}: status {ended.exit_code}: {ended.output[-1000:]}"
    if not ended.output.replace("\n", "").isprintable():
        return f"{arguments}: it prints what a terminal obeys"
    return f"{arguments}: it took {took_s:.1f} s" if took_s > PROCESSOR_S_MAX else ""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "by").touch()
    return tmp_path


@pytest.mark.parametrize("name", FILES)
def test_a_mutated_file_ends_a_command_as_documented(folder: Path, name: str) -> None:
    kind = next(kind for kind in KINDS if kind.name == name)
    path = folder / name
    found = []
    for number in range(MUTANTS):
        # others than those that go through the loader alone
        path.write_bytes(mutant(f"command {name}", kind.sound, number))
        found += [command(arguments, str(path), folder) for arguments in FILES[name]]
    assert [text for text in found if text] == []


@pytest.mark.parametrize("arguments", OPTIONS, ids=lambda arguments: f"{arguments[0]} {arguments[-2]}")
def test_a_mutated_option_ends_a_command_as_documented(folder: Path, arguments: tuple[str, ...]) -> None:
    texts = [data.decode("utf-8", "surrogateescape") for data in (*NUMBERS, *INSERTS)]
    found = [command(arguments, text, folder) for text in texts if "\0" not in text]
    assert [text for text in found if text] == []


def test_a_mutated_recording_is_recovered_or_refused(tmp_path: Path) -> None:
    found = []
    for place, kind in enumerate(recording_kinds(tmp_path)):
        found += _recovered(kind, tmp_path / f"{place}")
    assert found == []


def _recovered(kind: Kind, folder: Path) -> list[str]:
    texts = []
    for number in range(MUTANTS_RECORDED):
        run = folder / str(number)
        write_unfinished(run)
        (run / "summary.json").unlink()
        (run / kind.name).write_bytes(mutant(f"command {kind.name}", kind.sound, number))
        texts.append(command(("recover", "{}"), str(run), folder))
    return [f"{kind.name}: {text}" for text in texts if text]
