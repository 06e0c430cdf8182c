"""Runs cases as a user does, with the command in this process, and holds each against the invariants."""

from pathlib import Path

from typer.testing import CliRunner

from hil.cli import app
from tests.swarm.cases import bench_text, case
from tests.swarm.invariants import Ran, broken
from tests.swarm.witness import witnessed


def run_case(number: int, folder: Path) -> Ran:
    """Case ``number``; its files go below ``folder``."""
    bench = folder / f"case-{number}.toml"
    bench.write_text(bench_text(number), encoding="utf-8")
    run = folder / f"run-{number}"
    with witnessed() as drives:
        found = CliRunner().invoke(app, ["run", str(bench), "--record", str(run), "--json"])
    return Ran(case(number), run, found.exit_code, found.stdout, found.stderr, tuple(drives))


def failures(number: int, folder: Path) -> list[str]:
    """What case ``number`` breaks."""
    return [f"case {number}: {text}" for text in broken(run_case(number, folder))]
