"""Runs of a campaign back to back in one process, without logger, disk or viewer.

``python -m servobench.hil.campaign.worker`` is a process that does nothing else; see
:mod:`servobench.hil.campaign.pool`.
"""

import gc
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from servobench.drivers.errors import BadInput, BenchError
from servobench.drivers.timebase import MonotonicClock
from servobench.hil.campaign.identity import Identity, require_program
from servobench.hil.campaign.plan import CampaignPlan, Drawn, PlannedRun, refuse_real_time
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_files import BadInputs
from servobench.hil.control.own_code import OwnCodeFailed, object_of
from servobench.hil.execution.bench import run_bench
from servobench.hil.machine.held_process import watch_for_replacements
from servobench.hil.machine.refusals import explained
from servobench.hil.machine.stopping import Interrupted, StopRequest
from servobench.hil.recording.recorder import recorder_of
from servobench.hil.recording.run_recorder import MemoryRecorder, RunRecorder
from servobench.hil.reviewing.certificate_meter import CertificateState
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.verdict.metrics import METRICS, Beside
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import VerdictKind

COLLECTED_EVERY: Final = 50
"""Runs between two garbage collections: a run leaves some hundred kB in cycles, a collection takes some
milliseconds once the imports are frozen."""


def certificate_state(summary: Summary) -> str:
    """Return the state of a run's certificates; empty: its controllers have none."""
    states = {each["state"] for each in summary.certificates.values()}
    return next((state.value for state in CertificateState if state in states), "")


def _premises(summary: Summary, which: str) -> str:
    several = len(summary.certificates) > 1
    return "; ".join(
        f"{axis} {premise}" if several else premise
        for axis, each in summary.certificates.items()
        for premise in each[which]
    )


FIGURES: Final = {name: each for name, each in METRICS.items() if each.counted}
"""Figures kept for each run, by column name."""

Row = dict[str, Any]
"""A row of the table of a campaign: plain values by column."""
Answer = dict[str, Any]
"""Answer of a worker, plain values: ``row`` and ``took_ns`` of a run, and ``files`` opened since the last
answer; or ``error`` and ``status``: there is none."""


class NotTheSame(BenchError):
    """A repeated run has another digest: something in it is not deterministic."""

    exit_status = 70


class Finished(NamedTuple):
    """A finished run."""

    config: BenchConfig
    summary: Summary
    findings: list[str] | None
    """Findings of the user's check; None: there is no check."""


class Workshop:
    """Runs any run of a plan, in any order; shared data are loaded once."""

    def __init__(self, plan: CampaignPlan, stop: StopRequest | None = None) -> None:
        self._plan = plan
        self._stop = stop
        self._since_collected = 0
        self._clock = MonotonicClock()
        gc.collect()
        gc.freeze()

    @classmethod
    def of_sweep(cls, path: str, identity: Identity) -> "Workshop":
        """Make the workshop of a worker, which reads the sweep itself. Raises BadInput or BadInputs: one of
        its files, or the program here, is not that of the campaign."""
        require_program(identity["program"], path)
        plan = CampaignPlan.load(Path(path), identity)
        plan.require(identity)
        return cls(plan, StopRequest())

    def answers(self, chunk: Iterable[Any]) -> Iterator[Answer]:
        """Yield the answers for a chunk: pairs of a run's number and its draw. Raises as :meth:`row`."""
        for number, drawn in chunk:
            began = self._clock.now()
            row = self.row(number, Drawn(*drawn))
            took_ns = self._clock.now() - began
            yield {"row": row, "took_ns": took_ns, "files": self._plan.files.fresh()}

    def row(self, number: int, drawn: Drawn | None = None) -> Row:
        """Return the row of run ``number``; ``drawn``: as for :meth:`CampaignPlan.run`.

        Raises BadInput or BadInputs for an impossible run, and for a file that has changed since other runs
        opened it; Interrupted.
        """
        with self._plan.files.noting():
            planned = self._plan.run(number, drawn)
            done = self.finished(planned)
        self._since_collected += 1
        if self._since_collected == COLLECTED_EVERY:
            self._since_collected = 0
            gc.collect()
        return row_of_run(planned, done)

    def finished(self, planned: PlannedRun, record: Path | None = None) -> Finished:
        """Run a planned run to its end; ``record``: the folder of its recording.

        Raises as :meth:`row`, and OwnCodeFailed; its verdict reports any other end.
        """
        try:
            config = self._plan.bench.changed(planned.changes).config
            refuse_real_time(config, self._plan.bench.source)
            if not self._plan.own.checks:
                return Finished(config, self._run(config, planned, record, recorder_of), None)
            return self._checked(config, planned, record)
        except BenchError as error:
            error.add_note(f"run {planned.number}: {planned.labels}")
            raise

    def _checked(self, config: BenchConfig, planned: PlannedRun, record: Path | None) -> Finished:
        ended: list[Summary] = []

        def run() -> Any:
            memory: list[MemoryRecorder] = []

            def in_memory(plan: RecordingPlan) -> MemoryRecorder:
                memory.append(MemoryRecorder(plan, keep_all=True))
                return memory[-1]

            recording = in_memory if record is None else recorder_of
            ended.append(self._run(config, planned, record, recording))
            run_class = object_of("servobench:Run")  # above this floor: found as code of one's own finds it
            return run_class(config, record or memory[0], summary=ended[-1])

        findings = self._plan.own.findings(planned.seed, run)
        if len(ended) != 1:
            raise OwnCodeFailed(f"the check called run() {len(ended)} times, expected once")
        return Finished(config, ended[0], findings)

    def _run(
        self,
        config: BenchConfig,
        planned: PlannedRun,
        record: Path | None,
        recording: Callable[[RecordingPlan], RunRecorder],
    ) -> Summary:
        concluded: list[Summary] = []
        try:
            return run_bench(
                config,
                seed=planned.seed,
                record=record,
                keep=record is not None,
                allow_uncertified=self._plan.sweep.campaign.allow_uncertified,
                privileged=False,
                stop=self._stop,
                recording=recording,
                concluded=concluded.append,
            )
        except (BadInput, BadInputs, Interrupted):
            raise
        except BenchError:
            if not concluded:
                raise
            return concluded[-1]


def refusal(error: BenchError) -> Answer:
    """Return a worker's answer without a row."""
    notes = "".join(f"; {note}" for note in getattr(error, "__notes__", ()))
    return {"error": f"{error}{notes}", "status": error.exit_status}


def row_of_run(planned: PlannedRun, done: Finished) -> Row:
    """Return the row of the table. Raises Interrupted: such a run says nothing."""
    summary, verdict = done.summary, done.summary.verdict
    if ended_by := verdict.of(VerdictKind.INTERRUPTED):
        raise Interrupted("; ".join(ended_by))
    beside = Beside(summary.cycles * len(done.config.axes), summary.bus_load_percent)
    return {
        "run": planned.number,
        "point": planned.point,
        "replicate": planned.replicate,
        "seed": planned.seed,
        "weight": planned.weight,
        "counts": planned.counts,
        **planned.labels,
        "outcome": str(verdict.outcome),
        "passed": verdict.passed,
        "completed": verdict.completed,
        "reason": verdict.reason,
        "certificate": certificate_state(summary),
        "premises_left": _premises(summary, "premises_left"),
        "premises_unknown": _premises(summary, "premises_unknown"),
        "digest": summary.digest,
        **{name: figure.value(summary, beside) for name, figure in FIGURES.items()},
        **({} if done.findings is None else {"findings": done.findings}),
    }


def main() -> int:
    """Run as a worker of :mod:`servobench.hil.campaign.pool` until no more requests come."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    said = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what code of one's own prints is no answer
    watch_for_replacements()

    def tell(what: dict[str, Any]) -> None:
        said.write(json.dumps(what) + "\n")

    try:
        asked = json.loads(sys.stdin.readline())
        workshop = Workshop.of_sweep(asked["sweep"], asked["identity"])
        tell({"ready": True})
        for line in sys.stdin:
            for answer in workshop.answers(json.loads(line)):
                tell(answer)
    except BenchError as error:
        tell(refusal(error))
        return error.exit_status
    except BrokenPipeError:
        """Nobody asks any more."""
    except Exception as error:
        if (known := explained(error)) is None:
            raise
        tell(refusal(known))
        return known.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
