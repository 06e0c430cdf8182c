"""A drawn bench in simulated time, held against taps on the bus, the drives' own words and their shafts."""

import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Final
from unittest.mock import patch

from servobench.drivers.cia402.profile import State, state_of
from servobench.drivers.errors import BenchError
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution import bench
from servobench.hil.execution.world import World, WorldPlan
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.faults.outage_bus import Outages as AdapterOutages
from tests.outages.drawn import Outages, drawn, flooded
from tests.outages.outcome import Outcome
from tests.scenario.foreign_node import beside_the_bench
from tests.scenario.processes import EXAMPLES
from tests.truth.command_judge import judge_commands
from tests.truth.drawn_run import CRASHES
from tests.truth.judge import Timing, judge_axis
from tests.truth.rows import NO_INSTANT, READING_IS_A_SET, Told, told_by
from tests.truth.tapped_run import TappedRun, run_with_taps
from tests.truth.taps import SYNC_ID
from tests.truth.truth import AxisTruth, axis_truth

REST_RPM: Final = 1.0
LEFT_ALONE_S: Final = 3.0
"""After the bench has ended, before the shafts are looked at: a drive whose host is gone stops by itself."""
STATUSWORD: Final = 0x380
"""TPDO 3, which tells each change of it."""


STUCK: Final = "has taken no frame for a second"


def run_flooded(seed: int) -> Outcome:
    """The flooded bench of ``seed``: there is room again and again, so the bus is never down."""
    plan, zeros, start = flooded(seed), list[Instant](), AdapterOutages.start

    def begin(outages: AdapterOutages, now: Instant) -> None:
        zeros.append(now)
        start(outages, now)

    with patch.object(AdapterOutages, "start", begin):
        outcome = run(seed, plan)
    patience_s = plan.tables["loop"]["period_us"] / 2e6
    for due_at in outcome.due_at if zeros else []:
        wait_s = plan.room_after_s((due_at - zeros[0]) / NS_PER_S)
        outcome.refused += wait_s > 0.0
        outcome.no_room += wait_s > patience_s
    if STUCK in outcome.reason:
        outcome.wrong.append(f"taken for a bus that is down: {outcome.reason}")
    return outcome


def run(seed: int, plan: Outages | None = None) -> Outcome:
    """The drawn bench of ``seed``, or ``plan``."""
    outcome, plan = Outcome(seed), plan or drawn(seed)
    config = bench_from(plan.tables, f"seed {seed}", EXAMPLES)
    drives: list[SimulatedServo] = []
    try:
        with _surroundings(plan, drives):
            ran = run_with_taps(config)
        _hold(ran, config, outcome)
    except BenchError as error:
        outcome.wrong.append(f"no recording: {error}")
    except CRASHES:
        outcome.wrong.append(traceback.format_exc(limit=-3))
    for drive in drives:
        rpm = drive.drive.firmware.speed_rad_s / RAD_S_PER_RPM
        if abs(rpm) > REST_RPM or drive.drive.power.state is State.OPERATION_ENABLED:
            outcome.wrong.append(f"node {drive.node_id} left at {rpm:.0f} r/min, {drive.drive.power.state}")
    return outcome


@contextmanager
def _surroundings(plan: Outages, drives: list[SimulatedServo]) -> Iterator[None]:
    with ExitStack() as stack:
        stack.enter_context(beside_the_bench(seen=drives.append))
        inner = vars(bench)["open_world"]

        @contextmanager
        def open_world(asked: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
            with inner(asked, devices) as made:
                try:
                    yield made
                finally:
                    made.clock.sleep_until(Instant(made.clock.now() + round(LEFT_ALONE_S * NS_PER_S)))

        stack.enter_context(patch.object(bench, "open_world", open_world))
        if plan.beyond_the_run:
            stack.enter_context(patch.object(AdapterOutages, "stop", lambda _self: None))
        yield


def _hold(ran: TappedRun, config: BenchConfig, outcome: Outcome) -> None:
    verdict, rows, wrong = ran.summary.verdict, ran.rows, outcome.wrong
    outcome.take(ran.summary, rows, ran.events)
    if verdict.passed and ran.ended_by:
        wrong.append(f"passed, and ended by {ran.ended_by!r}")
    loop = config.loop
    timing = Timing(loop.period, loop.deadline, loop.horizon_periods)
    missing = 0
    for axis, name in enumerate(config.axes):
        node = config.drive[name].node
        truth = axis_truth(ran.log, node, READING_IS_A_SET)
        told = told_by(rows, axis, timing.period)
        readings, commands = judge_axis(told, truth, timing), judge_commands(told, truth)
        found = {
            **readings.misjudged,
            "bound broken": readings.bound_broken,
            "no row": readings.unaccounted,
            "SYNC's instant": readings.echo_wrong,
            "command's fate": commands.wrong,
            "command outside": commands.outside,
            "command unknown": commands.unknown,
            "command's instant": commands.echo_wrong,
        }
        wrong += [f"{name}: {kind}: {count}" for kind, count in found.items() if count]
        wrong += [f"  {text}" for text in (*readings.examples, *commands.examples)]
        wrong += [f"{name}: {text}" for text in _wrong_syncs(ran, told)]
        if told.size:
            missing += told.size - _came(truth, told, timing)
            if verdict.completed and (left := _left_enabled(ran, node, told)):
                wrong.append(f"{name}: completed, and the drive was {left}")
    outcome.judge_share(config, rows.size - missing)


def _wrong_syncs(ran: TappedRun, told: Told) -> Iterator[str]:
    """What the rows tell of SYNCs, and was not so on the bus."""
    handed = told["sync_handed_at"][told["sync_handed_at"] != NO_INSTANT]
    ends = [at for at, frame in ran.log.on_bus if frame.can_id == SYNC_ID]
    if handed.size and (on_bus := sum(at > handed[0] for at in ends)) != handed.size:
        yield f"{handed.size} SYNCs told, {on_bus} on the bus"


def _came(truth: AxisTruth, told: Any, timing: Timing) -> int:
    """Cycles whose reading was there by its deadline."""
    syncs = truth.handed_between(int(told["due_at"][0]), int(told["due_at"][-1]) + timing.period)
    readings = [sync.reading for sync in syncs if sync.reading is not None]
    return sum(reading.received_at - reading.heard.at <= timing.deadline for reading in readings)


def _left_enabled(ran: TappedRun, node: int, told: Any) -> State | None:
    """What the drive itself told on the bus between the first and the last cycle, if it was not enabled."""
    for at, frame in ran.log.on_bus:
        if frame.can_id == STATUSWORD + node and told["due_at"][0] <= at <= told["due_at"][-1]:
            state = state_of(int.from_bytes(frame.data[:2], "little"))
            if state is not State.OPERATION_ENABLED:
                return state
    return None
