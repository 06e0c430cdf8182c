"""Runs a drawn plan with the taps in it and holds all that it tells against the truth, strictly."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from tests.truth.adapter import STAMP_TICK_NS
from tests.truth.command_judge import CommandJudgement, judge_commands
from tests.truth.doubts import doubts
from tests.truth.drawn import TICK_US
from tests.truth.drawn_bench import DrawnPlan
from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.oracle import undecidable
from tests.truth.other_ways import explained_otherwise
from tests.truth.rows import READING_IS_A_SET, told_by
from tests.truth.standstills import Waiting
from tests.truth.tapped_run import Surroundings, TappedRun, run_with_taps
from tests.truth.taps import SYNC_ID
from tests.truth.truth import axis_truth, passages

ROOT: Final = Path(__file__).parents[2]
CYCLES: Final = 1500
FRAME_US: Final = 135
"""The longest frame on the wire, which a SYNC may have to wait for."""
WATERMARK_US: Final = 5.0
CRASHES: Final = (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError)
"""Errors that are none of the bench's own: a defect, of the bench or of the judge."""


@dataclass(slots=True)
class Verdict:
    """What came of a drawn plan."""

    plan: DrawnPlan
    readings: Judgement = field(default_factory=Judgement)
    commands: CommandJudgement = field(default_factory=CommandJudgement)
    doubts: Counter[tuple[str, bool]] = field(default_factory=Counter)
    """Rows in doubt by cause, and whether nobody could decide them, as far as the oracle tells."""
    undecidable: int = 0
    """Rows of drives without stamps that nobody could decide, in doubt or not."""
    ambiguous: int = 0
    """Rows of drives without stamps that have another explanation (tests/truth/other_ways.py)."""
    unsure_unambiguous: int = 0
    """Rows in doubt that have none."""
    ended_by: str = ""
    """The error that ended the run before its time, or that kept it from beginning."""

    @property
    def wrong(self) -> dict[str, int]:
        """What is wrong, by kind; nothing if all holds."""
        readings, commands = self.readings, self.commands
        found = {
            **readings.misjudged,
            "bound broken": readings.bound_broken,
            "no row": readings.unaccounted,
            "SYNC's instant": readings.echo_wrong,
            "command's fate": commands.wrong,
            "command outside": commands.outside,
            "command unknown": commands.unknown,
            "command's instant": commands.echo_wrong,
            "ended": bool(self.ended_by),
        }
        return {kind: count for kind, count in found.items() if count}

    @property
    def examples(self) -> list[str]:
        """The first of what is wrong, in words."""
        ended = [f"ended by: {self.ended_by}"] if self.ended_by else []
        return [*ended, *self.readings.examples, *self.commands.examples]


def judged(plan: DrawnPlan, cycles: int = CYCLES) -> Verdict:
    """``cycles`` planned cycles of every axis of ``plan``."""
    verdict = Verdict(plan)
    config = bench_config(plan, cycles)
    try:
        run = run_with_taps(config, Surroundings(plan.clock_starts_at_us, plan.adapter, plan.standstills))
        verdict.ended_by = run.ended_by
        if run.rows.size:
            _judge(run, config, verdict)
    except BenchError as error:
        verdict.ended_by = f"{error}"
    except CRASHES as error:
        verdict.ended_by = f"{type(error).__name__}: {error}"
    return verdict


def _judge(run: TappedRun, config: BenchConfig, verdict: Verdict) -> None:
    plan = verdict.plan
    timing = timing_of(plan, config)
    seen = passages(run.log, plan.heard)
    for axis, name in enumerate(config.axes):
        truth = axis_truth(run.log, config.drive[name].node, READING_IS_A_SET, plan.heard, seen)
        told = told_by(run.rows, axis, timing.period)
        verdict.readings.add(judge_axis(told, truth, timing))
        verdict.commands.add(judge_commands(told, truth, Duration(0), timing.stamp_error))
        open_to_all = set[int]() if plan.has_stamps else undecidable(truth, timing.period)
        verdict.undecidable += len(open_to_all.intersection(told["sync_handed_at"].tolist()))
        verdict.doubts += doubts(told, truth, timing, open_to_all)
        if not plan.has_stamps:
            has_others = np.isin(told["sync_handed_at"], list(explained_otherwise(truth)))
            verdict.ambiguous += int(has_others.sum())
            verdict.unsure_unambiguous += int(((told["certain"] == 0) & ~has_others).sum())


def timing_of(plan: DrawnPlan, config: BenchConfig) -> Timing:
    """What the judge has to know of ``plan``."""
    error = _stamp_error(plan)
    unseen_us = plan.sync_jitter_us + plan.simulation.get("stamp_resolution_us", 1.0) + TICK_US
    if plan.adapter is not None and error is None:  # nothing tells what a SYNC waited in front of the bus
        unseen_us += plan.adapter.late_us + plan.sync_wait_us + FRAME_US
    if plan.standstills is not None and plan.standstills.waiting is not Waiting.ANSWERS:
        unseen_us += plan.standstills.longest_us
    unseen = (error or 0) + round(unseen_us * NS_PER_US)
    loop = config.loop
    return Timing(loop.period, loop.deadline, loop.horizon_periods, plan.heard, error, Duration(unseen))


def _stamp_error(plan: DrawnPlan) -> Duration | None:
    """A host that stands still fetches later, and where that is what stamps a frame its stamp is as late."""
    adapter = plan.adapter
    if adapter is None:
        return Duration(0)
    if adapter.basis is EchoBasis.NONE:
        return None
    if adapter.basis is EchoBasis.HARDWARE:
        return Duration(STAMP_TICK_NS)
    stalls = plan.faults.get("host_stall", ()) if adapter.basis is EchoBasis.RECEIPT else ()
    late_us = adapter.late_us + sum(stall["late_max_us"] for stall in stalls)
    return Duration(round(late_us * NS_PER_US))


def bench_config(plan: DrawnPlan, cycles: int) -> BenchConfig:
    """The bench of a plan. Raises BadInput or BadInputs."""
    drives = {f"axis{number + 1}": _drive(plan, number) for number in range(plan.axes)}
    made = _tables(plan, cycles) | {
        "drive": drives,
        "reference": {
            name: [{"kind": "sine", "at_s": 0.0, "amplitude_rpm": 400.0, "frequency_hz": 20.0}]
            for name in drives
        },
    }
    return bench_from(made, f"seed {plan.seed}", ROOT / "examples")


def _drive(plan: DrawnPlan, number: int) -> dict[str, Any]:
    """A weak controller whose command moves by up to 0.05 N m a cycle: hardly two neighbours are equal."""
    return {
        "node": number + 1,
        "motor": "motors/ling2012.toml",
        "stamp_resolution_us": plan.stamp_resolution_us,
        "simulation": {
            "clock_drift_ppm": plan.drifts_ppm[number],
            "lacks": [] if plan.has_stamps else ["1013"],
            **plan.simulation,
        },
        "limits": {"speed_max_rpm": 2500.0, "torque_max_nm": 2.0, "dropouts_consecutive_max": 1_000_000},
        "controller": {"kind": "pid", "proportional_nm_s_rad": 0.01},
    }


def _tables(plan: DrawnPlan, cycles: int) -> dict[str, Any]:
    """The bench of ``plan`` as a bench file has it, less its drives and references."""
    made: dict[str, Any] = {
        "bench": {"name": "truth", "duration_s": cycles * plan.period_us * 1e-6, "seed": plan.seed},
        "loop": {
            "period_us": plan.period_us,
            "deadline_us": plan.deadline_us,
            "horizon_periods": plan.horizon_periods,
            "actuation": plan.actuation,
            "position_every_cycles": plan.position_every,
            "command_readback": plan.readback,
            "sync": plan.sync,
            "sync_watermark_us": WATERMARK_US,
        },
    }
    if traffic := list(_traffic_tables(plan)):
        made["bus"] = {"background": traffic}
    if plan.faults:
        made["faults"] = plan.faults
    return made


def _traffic_tables(plan: DrawnPlan) -> Iterator[dict[str, Any]]:
    if plan.sync == "foreign":
        yield {
            "can_id": SYNC_ID,
            "bytes_max": 0,
            "period_us": plan.producer_period_us,
            "jitter_us": plan.producer_jitter_us,
        }
    yield from plan.background
