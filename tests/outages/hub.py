"""A drawn bench in real time, held against a third client of its hub.

The hub has a process, so have the listener and the drives, which stay for all runs. The bench is in this one.
"""

import os
import traceback
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import BenchError
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.bench import run_bench
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.side_rows import TextEvent
from servobench.hil.testing.hosted import DriveProcess
from servobench.hil.testing.wire import pdo_plans
from servobench.hil.verdict.summary import Summary
from tests.outages.drawn import drawn
from tests.outages.outcome import Outcome
from tests.scenario.processes import EXAMPLES, HIL, observer
from tests.truth.drawn_run import CRASHES
from tests.truth.hub_listener import FrameTable, heard, listening
from tests.truth.rows import MISSED, NO_INSTANT, NOT_SENT, USED, Told, told_by
from tests.truth.taps import SYNC_ID

REST_LIMIT_S: Final = 4.0
"""After the bench has ended: a drive whose host is gone stops by itself."""
SET_POINTS: Final = (Object.TARGET_TORQUE, Object.TARGET_VELOCITY)


class HubRuns:
    """Runs on a hub of their own, with two simulated drives."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._name = f"outages-{os.getpid()}"
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        command = [*HIL, "simulate", "--bus", self.bus, "--node", "1-2"]
        drives = DriveProcess(command, self._folder / "drives.log")
        self._stack.callback(drives.stop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def bus(self) -> str:
        """SPEC of the hub."""
        return f"hub:{self._name}"

    def run(self, seed: int) -> Outcome:
        """The drawn bench of ``seed``."""
        outcome, frames = Outcome(seed), self._folder / "frames.bin"
        config = bench_from(drawn(seed, real_time=True).tables, f"seed {seed}", EXAMPLES)
        recorders: list[MemoryRecorder] = []
        summaries: list[Summary] = []

        def in_memory(plan: RecordingPlan) -> MemoryRecorder:
            recorders.append(MemoryRecorder(plan, keep_all=True))
            return recorders[-1]

        with listening(self._name, frames):
            try:
                run_bench(
                    config,
                    bus_spec=self.bus,
                    privileged=False,
                    recording=in_memory,
                    concluded=summaries.append,
                )
            except BenchError as error:
                if not summaries:
                    outcome.wrong.append(f"no summary: {error}")
            except CRASHES:
                outcome.wrong.append(traceback.format_exc(limit=-3))
            self._await_rest(outcome)
        if summaries:
            events, _ = recorders[0].told()
            texts = [event.text for event in events if isinstance(event, TextEvent)]
            outcome.take(summaries[0], recorders[0].rows(), texts)
            self._hold(config, recorders[0], heard(frames), outcome)
        return outcome

    def _await_rest(self, outcome: Outcome) -> None:
        with observer(self.bus) as drive:
            try:
                drive.time_to_rest(drive.now(), REST_LIMIT_S)
            except (AssertionError, BenchError) as error:
                outcome.wrong.append(f"left turning: {error}")

    def _hold(
        self, config: BenchConfig, recorder: MemoryRecorder, frames: FrameTable, outcome: Outcome
    ) -> None:
        plans, used = pdo_plans(config), 0
        for axis, name in enumerate(config.axes):
            told = told_by(recorder.rows(), axis, config.loop.period)
            used += int((told["fate"] == USED).sum())
            outcome.wrong += [f"{name}: {text}" for text in _wrong(told, frames, plans[name])]
        outcome.judge_share(config, used)


def _wrong(told: Told, frames: FrameTable, plan: PdoPlan) -> Iterator[str]:
    """What the rows of one axis say, and was not so on the hub."""
    if not told.size:
        return
    if not np.array_equal(told["sequence"], np.arange(1, told.size + 1)):
        yield "rows are missing or double"
    ends = frames["at"][frames["can_id"] == SYNC_ID]
    sent = told[told["fate"] != MISSED]
    echoed = sent["sync_on_bus_at"][sent["sync_on_bus_at"] != NO_INSTANT]
    if strange := np.setdiff1d(echoed, ends).size:
        yield f"{strange} SYNCs were not on the bus when they are told to have been"
    if sent.size and (on_bus := int((ends > sent["sync_handed_at"][0]).sum())) != sent.size:
        yield f"{sent.size} SYNCs told, {on_bus} on the bus"
    reading_id = next(
        pdo.cob_id for pdo in plan.tpdos if any(entry.index == VELOCITY for entry in pdo.entries)
    )
    came = frames["at"][frames["can_id"] == reading_id]
    used = told["received_at"][told["fate"] == USED]
    if strange := np.setdiff1d(used, came).size:
        yield f"{strange} readings used that were not on the bus then"
    yield from _wrong_commands(told, frames, plan)


def _wrong_commands(told: Told, frames: FrameTable, plan: PdoPlan) -> Iterator[str]:
    """The set-points on the bus are those of the rows, in their order, less those that are not sent."""
    handed = told[told["command_handed_at"] != NO_INSTANT]
    if not handed.size:
        return
    rpdo = plan.rpdos[0]
    first, size = _set_point(rpdo)
    mine = frames[(frames["can_id"] == rpdo.cob_id) & (frames["at"] > handed["command_handed_at"][0])]
    on_bus = [
        int.from_bytes(bytes(data).ljust(8, b"\0")[first : first + size], "little", signed=True)
        for data in mine["data"]
    ]
    sent = handed["command_raw"][handed["command_fate"] != NOT_SENT].tolist()
    if sent[: len(on_bus)] != on_bus[: len(sent)] or len(on_bus) < len(sent):
        yield f"{len(sent)} commands told, {len(on_bus)} on the bus, or other ones"


def _set_point(rpdo: Any) -> tuple[int, int]:
    bit = 0
    for entry in rpdo.entries:
        if entry.index in SET_POINTS:
            return bit // 8, entry.bits // 8
        bit += entry.bits
    raise AssertionError("RPDO 1 has no set-point")


VELOCITY: Final = int(Object.VELOCITY_ACTUAL_VALUE)
