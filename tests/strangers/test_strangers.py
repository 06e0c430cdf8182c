"""Some of what ``python -m tests.strangers`` draws."""

import pytest

from tests.strangers.forger import PHASES
from tests.strangers.world import DURATION_S, clean_run, forged_run
from tests.truth.drawn import drawn_plan


@pytest.mark.parametrize(("world", "seeds"), [("quiet", range(1, 6)), ("losses", range(4, 5))])
def test_single_forged_frames_are_named(world: str, seeds: range) -> None:
    runs = [forged_run(seed, world) for seed in seeds]
    assert {each.phase for run in runs for each in run.forgeries} == set(PHASES)
    assert world in DURATION_S
    for run in runs:
        assert (run.named, run.ended_by) == ([*run.forgeries], "")


@pytest.mark.parametrize("seed", [3, 4, 6])
def test_no_stranger_is_seen_where_there_is_none(seed: int) -> None:
    """Among them SYNCs of another node, which go on while drives are stopped."""
    run = clean_run(drawn_plan(seed), 600, untold=seed % 4 == 0)
    assert run.cycles >= 600
    assert run.alarms == ()
