"""Cells of the table that no other test has: ``make draws`` has more of them, ``make exits`` all."""

from pathlib import Path

import pytest

from tests.draws import few_of
from tests.exits.cells import Cell
from tests.exits.findings import findings
from tests.exits.one_run import run_cell

pytestmark = pytest.mark.xdist_group("real time")

CELLS = (
    Cell("hub", "host", "kill", "enabling"),
    Cell("hub", "drive", "stop", "running"),
    Cell("simulated", "disk", "full", "stopped"),
    Cell("hub", "host", "stop", "running", "csv"),
    Cell("hub", "host", "kill", "running", "csp"),
    Cell("simulated", "disk", "slow", "running"),
)


@pytest.mark.parametrize("cell", few_of(CELLS, 3), ids=str)
def test_what_a_run_comes_to_is_told(cell: Cell, tmp_path: Path) -> None:
    ended = run_cell(cell, tmp_path)
    assert findings(ended) == [], ended.ran.case.said
