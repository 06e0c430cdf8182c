"""Runs a plan with the taps in it, and says whether it held what is asked of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Duration
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_axis import Simulation
from servobench.hil.configuration.config_files import BadInputs
from tests.truth.command_judge import CommandJudgement, judge_commands
from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.plans import NO_LIMIT, Plan
from tests.truth.rows import MISSED, READING_IS_A_SET, told_by
from tests.truth.tapped_run import Surroundings, run_with_taps
from tests.truth.taps import SYNC_ID
from tests.truth.truth import axis_truth, spacings_below

ROOT: Final = Path(__file__).parents[2]
SEED: Final = 11
LOSS_ERROR_POINTS: Final = 1.0
NEW_KEYS: Final = ("host_stall", "side")
"""Of fault plans: a plan with one of these that this version does not know is skipped, with a word."""
DENSE_BUS_EVERY: Final = 10
"""Three axes at 1 kHz fit a bus of 1 Mbit/s if the position comes with every tenth SYNC."""


@dataclass(slots=True)
class Outcome:
    """What came of a plan."""

    plan: Plan
    skipped: str = ""
    """Why it was not run."""
    ended_by: str = ""
    readings: Judgement = field(default_factory=Judgement)
    commands: CommandJudgement = field(default_factory=CommandJudgement)
    bursts_handed: int = 0
    """SYNCs handed over less than half a period after the last."""
    bursts_on_bus: int = 0
    """SYNCs whose ends on the bus are closer than that."""

    def broken(self) -> list[str]:
        """What is asked of the plan and was not held."""
        if self.skipped:
            return []
        found, plan, readings = [], self.plan, self.readings
        asked: Sequence[tuple[str, float, float]] = (
            ("misjudged", readings.wrong, 0),
            ("unaccounted", readings.unaccounted, 0),
            ("uncertain far from a step", 0 if not plan.decides else readings.uncertain_far, 0),
            ("instants of SYNCs on the bus wrong", readings.echo_wrong, 0),
            ("sampled_at_error_ns broken", readings.bound_broken, 0),
            ("missed without a cause", readings.fates[MISSED] if plan.heard and not plan.faults else 0, 0),
            ("SYNC bursts handed over", self.bursts_handed, 0),
        )
        found += [f"{what}: {count}" for what, count, most in asked if count > most]
        error_us = readings.delay_error_us(99)
        if plan.delay_us != NO_LIMIT and not error_us <= plan.delay_us:  # NaN, of no certain reading, too
            found.append(f"delay error p99: {error_us:.1f} us")
        if self.ended_by:
            found.append(f"ended by: {self.ended_by}")
        return found + (self._commands_broken() if plan.commands else [])

    def _commands_broken(self) -> list[str]:
        commands, found = self.commands, []
        least, most = commands.told_loss_percent
        true = commands.true_loss_percent
        if not least - LOSS_ERROR_POINTS <= true <= most + LOSS_ERROR_POINTS:
            found.append(f"commands lost: told {least:.1f} to {most:.1f} %, {true:.1f} %")
        for percentile in (50, 99, 100):
            told_us, true_us = commands.delay_us(percentile)
            if not abs(told_us - true_us) <= self.plan.command_delay_us:
                found.append(f"command delay p{percentile}: told {told_us:.0f} us, {true_us:.0f} us")
        for what in ("wrong", "unknown", "outside", "echo_wrong"):
            if count := getattr(commands, what):
                found.append(f"commands {what}: {count}")
        return found


def run_plan(plan: Plan, cycles: int) -> Outcome:
    """``cycles`` planned cycles of every axis of ``plan``."""
    outcome = Outcome(plan)
    try:
        config = bench_config(plan, cycles)
    except (BadInput, BadInputs) as error:
        unknown = [key for key in NEW_KEYS if key in plan.faults and key in str(error)]
        if not unknown:
            raise
        outcome.skipped = f"fault plans know no {' or '.join(unknown)} here"
        return outcome
    _run(config, outcome)
    return outcome


def _run(config: BenchConfig, outcome: Outcome) -> None:
    run = run_with_taps(config, Surroundings(outcome.plan.clock_starts_at_us))
    outcome.ended_by = run.ended_by
    heard = outcome.plan.heard
    timing = Timing(config.loop.period, config.loop.deadline, config.loop.horizon_periods, heard)
    for axis, name in enumerate(config.axes):
        truth = axis_truth(run.log, config.drive[name].node, READING_IS_A_SET, heard)
        told = told_by(run.rows, axis, timing.period)
        outcome.readings.add(judge_axis(told, truth, timing))
        outcome.commands.add(judge_commands(told, truth))
    if not run.rows.size:
        return
    begin, half = int(run.rows["due_at"].min()), Duration(timing.period // 2)
    handed = [passed.at for passed in run.log.handed if passed.frame.can_id == SYNC_ID]
    on_bus = [passed.at for passed in run.log.on_bus if passed.frame.can_id == SYNC_ID]
    outcome.bursts_handed = spacings_below([at for at in handed if at >= begin], half)
    outcome.bursts_on_bus = spacings_below([at for at in on_bus if at >= begin], half)


def bench_config(plan: Plan, cycles: int, on_hub: bool = False) -> BenchConfig:
    """The bench of a plan. ``on_hub``: other nodes are other processes'. Raises BadInput or BadInputs."""
    tables = _tables(plan, cycles)
    if on_hub:
        tables.pop("bus", None)
    return bench_from(tables, plan.name, ROOT / "examples")


def _tables(plan: Plan, cycles: int) -> dict[str, Any]:
    """A weak controller around a motor at low speed: what is judged is time, so nothing must stop the run.

    The speed never stands still, so that two readings mixed differ.
    """
    names = [f"axis{number}" for number in range(1, plan.axes + 1)]
    sparse = (plan.axes > 1 and not plan.commands) or not (plan.stamps or _lacks_is_known())
    tables: dict[str, Any] = {
        "bench": {"name": "truth", "duration_s": cycles * plan.period_us * 1e-6, "seed": SEED},
        "loop": {
            "period_us": plan.period_us,
            "deadline_us": plan.deadline_us,
            "actuation": plan.actuation,
            "position_every_cycles": DENSE_BUS_EVERY if sparse else 1,
            "command_readback": "event" if plan.commands else "sync",
            "sync": plan.sync,
        },
        "drive": {name: _drive(plan, number) for number, name in enumerate(names)},
        "reference": {name: [_reference(plan)] for name in names},
    }
    if plan.sync == "foreign":
        producer = {
            "can_id": SYNC_ID,
            "bytes_max": 0,
            "period_us": plan.producer_period_us,
            "jitter_us": plan.producer_jitter_us,
        }
        tables["bus"] = {"background": [producer]}
    if faults := plan.fault_tables():
        tables["faults"] = faults
    return tables


def _drive(plan: Plan, number: int) -> dict[str, Any]:
    simulation: dict[str, Any] = {"clock_drift_ppm": plan.drift_ppm * (1, -1, 0)[number]}
    if not plan.stamps and _lacks_is_known():
        simulation["lacks"] = ["1013"]
    age_us = plan.acts_at_age_us
    return {
        "node": number + 1,
        "motor": "motors/ling2012.toml",
        "simulation": simulation,
        "compensator": {"kind": "arrival"} if age_us is None else {"kind": "stamp", "delay_us": age_us},
        "limits": {"speed_max_rpm": 2500.0, "torque_max_nm": 2.0, "dropouts_consecutive_max": 1_000_000},
        "controller": {"kind": "pid", "proportional_nm_s_rad": 0.01},
    }


def _reference(plan: Plan) -> dict[str, Any]:
    """Where commands are judged, fast: 400 r/min at 20 Hz move the command by up to 0.05 N m a cycle."""
    amplitude_rpm, frequency_hz = (400.0, 20.0) if plan.commands else (200.0, 2.0)
    return {"kind": "sine", "at_s": 0.0, "amplitude_rpm": amplitude_rpm, "frequency_hz": frequency_hz}


def _lacks_is_known() -> bool:
    """Whether a simulated drive can be made without 1013h."""
    return "lacks" in Simulation.model_fields
