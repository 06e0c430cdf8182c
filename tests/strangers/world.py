"""One run with forged frames, and one without: which were named."""

from dataclasses import dataclass, field
from random import Random
from typing import Any, Final
from unittest.mock import patch

from servobench.drivers.errors import BenchError
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.execution import bench as bench_module
from servobench.hil.execution.bench import run_bench
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import VerdictKind
from tests.scenario.foreign_node import beside_the_bench
from tests.scenario.processes import EXAMPLES
from tests.strangers.forger import PHASES, RUNNING_ALONE, SENT, Forger, Forgery
from tests.truth.drawn_bench import DrawnPlan
from tests.truth.drawn_run import bench_config
from tests.truth.tapped_run import Surroundings, run_with_taps

CONNECTING_S: Final = (0.005, 0.08)
BEGINS_S: Final = 0.3
"""After power-on the cycles have begun."""
STOPPING_S: Final = (0.22, 0.28)
"""After the cycles' duration: the last one is over, and the shaft is still watched at rest."""
LOSSES: Final = (0.005, 0.02, 0.05)
DURATION_S: Final = {"quiet": 0.6, "losses": 4.0}


@dataclass(slots=True)
class ForgedRun:
    """What became of a run with one forged frame in each phase."""

    forgeries: tuple[Forgery, ...] = ()
    named: list[Forgery] = field(default_factory=list)
    ended_by: str = ""


def forged_run(seed: int, world: str) -> ForgedRun:
    """``world``: "quiet", or "losses" of readings and commands."""
    draw = Random(f"{seed} {world}")
    duration_s = DURATION_S[world]
    kinds = draw.sample([*SENT], 3)
    forgeries: list[Forgery] = []
    for phase, kind in zip(PHASES, kinds, strict=True):
        kind = draw.choice([*SENT]) if phase == "running" else kind
        if phase != "running" and kind in RUNNING_ALONE:
            continue
        first_s, last_s = {
            "connecting": CONNECTING_S,
            "running": (BEGINS_S + duration_s / 2.0, BEGINS_S + duration_s - 0.15),
            "stopping": (duration_s + STOPPING_S[0], duration_s + STOPPING_S[1]),
        }[phase]
        if kind not in [each.kind for each in forgeries]:
            forgeries.append(Forgery(kind, phase, draw.uniform(first_s, last_s)))
    forger = Forger(forgeries, draw)
    changes: dict[str, Any] = {
        "bench.duration_s": duration_s,
        "bench.seed": seed,
        "load": {},
        "verdict": {"dropouts_percent_max": 100},
        "faults": {"loss": [{"probability": draw.choice(LOSSES)}]} if world == "losses" else {},
    }
    config = Bench.load(EXAMPLES / "ling2012.toml").changed(changes).config
    summaries: list[Summary] = []
    ended_by = ""
    with beside_the_bench(forger):
        try:
            run_bench(config, keep=False, privileged=False, concluded=summaries.append)
        except BenchError as error:
            ended_by = str(error)
    texts = summaries[-1].verdict.of(VerdictKind.DISTURBED)
    run = ForgedRun(tuple(forger.sent), ended_by=ended_by)
    run.named += [forgery for forgery in forger.sent if any(SENT[forgery.kind][1] in text for text in texts)]
    return run


@dataclass(slots=True)
class CleanRun:
    """What a run without strangers said of them."""

    alarms: tuple[str, ...] = ()
    cycles: int = 0
    ended_by: str = ""


def clean_run(plan: DrawnPlan, cycles: int, *, untold: bool) -> CleanRun:
    """``untold``: the bench is not told which faults make frames come twice, as where another process injects
    them."""
    config = bench_config(plan, cycles)
    surroundings = Surroundings(plan.clock_starts_at_us, plan.adapter)
    try:
        if untold:
            with patch.object(bench_module, "made_twice", lambda _faults: set()):
                run = run_with_taps(config, surroundings)
        else:
            run = run_with_taps(config, surroundings)
    except BenchError as error:
        return CleanRun(ended_by=str(error))
    alarms = run.summary.verdict.of(VerdictKind.DISTURBED)
    return CleanRun(alarms, run.summary.cycles * plan.axes, run.ended_by)
