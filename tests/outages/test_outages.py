"""A few of the drawn runs, each held against taps, drives and shafts; ``make outages`` draws many."""

from pathlib import Path

import pytest

from tests.draws import few_of
from tests.outages import simulated
from tests.outages.hub import HubRuns


@pytest.mark.parametrize("seed", [299, 327, 328, *few_of(range(1, 17), 4)])
def test_a_run_through_outages_tells_what_happened_and_leaves_no_drive_turning(seed: int) -> None:
    assert simulated.run(seed).wrong == []


@pytest.mark.parametrize("seed", [3, 14, 24, 36])
def test_a_run_beside_a_flood_finds_the_room_that_there_is(seed: int) -> None:
    """The first three were told that the bus is down: retries were in step with the flood. In the last a
    command that acted was told lost."""
    assert simulated.run_flooded(seed).wrong == []


@pytest.mark.xdist_group("real time")
def test_the_same_in_real_time(tmp_path: Path) -> None:
    with HubRuns(tmp_path) as runs:
        assert runs.run(2).wrong == []
