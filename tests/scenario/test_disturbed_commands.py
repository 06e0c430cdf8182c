"""Others on the bus while ``hil measure`` and ``hil commission`` work: their results are disturbed."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app
from servobench.hil.commissioning import commission
from servobench.hil.commissioning.commission import all_steps
from servobench.hil.execution import world
from servobench.hil.execution.world import World, WorldPlan
from servobench.hil.measuring import measure
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import ForeignNode, put_on_the_bus

WRITE = Frame(0x601, bytes.fromhex("2B7E600055000000"))
"""Of 607Eh of node 1."""


def hil(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments), "--bus", "simulated", "--node", "1", "--json"])


@pytest.fixture
def other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another node writes into the drive once, while it is measured."""

    @contextmanager
    def open_world(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        with world.open_world(plan, devices) as made:
            put_on_the_bus(made, ForeignNode(WRITE, 0.5))
            yield made

    for room in (measure, commission):
        monkeypatch.setattr(room, "open_world", open_world)


@pytest.mark.usefixtures("other")
@pytest.mark.parametrize(
    ("allow", "status"), [((), 4), (("--allow", "sdo_write", "--allow", "sdo_answer"), 0)]
)
def test_a_measurement_that_others_disturbed_is_not_trusted_unless_it_is_allowed(
    allow: tuple[str, ...], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = hil("measure", "--cycles", "500", *allow)
    disturbed = json.loads(done.stdout)["disturbed"]
    assert (done.exit_code, bool(disturbed)) == (status, status == 4), done.stderr
    if disturbed:
        assert disturbed[0].startswith("SDO write of 607Eh")


@pytest.mark.usefixtures("other")
def test_a_commissioning_that_others_disturbed_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of its first steps."""
    steps = all_steps()[:4]
    monkeypatch.setattr(commission, "all_steps", lambda: steps)
    done = hil("commission", "--rehearse", "1", "--yes", "--out", tmp_path / "out")
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert figures["disturbed"][0].startswith("SDO write of 607Eh")
    assert json.loads(done.stdout)["disturbed"] == figures["disturbed"]
    assert "disturbed: SDO write of 607Eh" in done.stderr
    assert done.exit_code == 4, done.stderr


def test_what_may_be_allowed_is_named() -> None:
    done = hil("measure", "--allow", "everything")
    assert done.exit_code == 2
    assert "--allow: found 'everything', expected one of nmt, sync," in done.stderr
