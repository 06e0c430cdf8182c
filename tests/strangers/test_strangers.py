"""Some of what ``python -m tests.strangers`` draws."""

import pytest

from servobench.hil.configuration.bench_file import Bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import VerdictKind
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import ForeignNode, beside_the_bench
from tests.scenario.processes import EXAMPLES
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


@pytest.mark.parametrize(("broken_off", "disturbs"), [("80 00 10 00", False), ("80 72 60 00", True)])
def test_a_read_that_its_asker_breaks_off_is_a_read(broken_off: str, disturbs: bool) -> None:
    """As ``hil simulate`` does that looks whether its node-ID is free, while a bench waits for it."""
    asks = ForeignNode(Frame(0x601, bytes.fromhex("40 00 10 00 00 00 00 00")), 0.5)
    breaks_off = ForeignNode(Frame(0x601, bytes.fromhex(broken_off + "00 00 04 05")), 0.6)
    config = Bench.load(EXAMPLES / "ling2012.toml").changed({"bench.duration_s": 0.6, "load": {}}).config
    summaries: list[Summary] = []
    with beside_the_bench(asks, breaks_off):
        run_bench(config, keep=False, privileged=False, concluded=summaries.append)
    assert bool(summaries[-1].verdict.of(VerdictKind.DISTURBED)) == disturbs
