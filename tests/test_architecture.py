"""docs/architecture.md draws the floors that import-linter holds."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = {
    contract["containers"][0].rpartition(".")[2]: [set(layer.split(" | ")) for layer in contract["layers"]]
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    if "exhaustive" in contract
}


def drawn(room: str) -> list[set[str]]:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    _, _, table = text.partition(f"| {room} | holds |\n|---|---|\n")
    rows = table.split("\n\n")[0].splitlines()
    return [set(re.findall(r"`(\w+)`", row.split("|")[1])) for row in rows]


@pytest.mark.parametrize("room", ["hil", "virtual_bus", "drivers", "design"])
def test_the_page_draws_the_floors_that_ci_holds(room: str) -> None:
    assert drawn(room) == FLOORS[room]


@pytest.mark.parametrize("room", ["hil", "virtual_bus", "drivers", "design"])
def test_each_floor_says_what_it_holds(room: str) -> None:
    told = {
        path.parent.name: path.read_text(encoding="utf-8").strip()
        for path in (ROOT / room).glob("*/__init__.py")
    }
    assert [name for name, text in told.items() if not text.startswith('"""')] == []
