"""A whole run: the bus, the drives, the loop, the recording, and a safe end whatever happens in between."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.adapters import parse_bus_spec
from drivers.drive_setup import DriveSettings
from drivers.errors import BenchError, PeerFault
from drivers.network import CanopenNetwork
from drivers.servo import ServoDrive
from drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock, duration_s, utc_stamp
from hil import assembly
from hil.configuration.config import BenchConfig
from hil.configuration.config_axis import RampReference, Reference, StepReference
from hil.figures.summary import RunOutcome, Summary, VerdictLimits
from hil.load_machine import ObjectLoadMachine, find_load_machine
from hil.loop import Loop, LoopOutcome, LoopTiming
from hil.machine.realtime import quiet_garbage_collector, realtime_process
from hil.machine.stopping import StopRequest, stop_signals
from hil.recording.recorder import Recorder, start_recording
from hil.recording.recording_plan import AxisPlan, RecordingPlan, ReviewPlan
from hil.simulated_drives import simulated_drives
from hil.terminal.progress import Progress
from hil.world import World, WorldPlan, check_time, open_world
from virtual_bus.fault_injection.fault_log import FaultLog

ENABLE_TIMEOUT_S = 2.0
RUNS_FOLDER = Path("runs")


@dataclass(frozen=True, slots=True)
class BenchResult:
    """What a run came to."""

    summary: dict[str, Any]
    """What ``hil run --json`` prints."""
    passed: bool
    interrupted: bool
    recording: Path | None


def run_bench(
    config: BenchConfig,
    *,
    bus_spec: str | None,
    time: str | None,
    seed: int | None,
    record: Path | None,
    view: bool,
    progress: Progress,
) -> BenchResult:
    """Run a bench and review it.

    ``bus_spec``, ``time``, ``seed``: what the command line puts in place of the file's. Raises BadInput
    before anything moves, PeerFault if bus or drive failed; in every case the drives are brought to
    rest and the recording is closed first.
    """
    spec = parse_bus_spec(bus_spec or config.bus.spec, "--bus" if bus_spec else config.source)
    paced = check_time(spec, time)
    seed = config.bench.seed if seed is None else seed
    log = FaultLog() if config.fault_plan is not None else None
    background = tuple(entry.stream for entry in config.bus.background)
    world_plan = WorldPlan(
        spec, config.bus.bitrate_bit_s, paced, config.fault_plan, seed, fault_log=log, background=background
    )
    devices = simulated_drives(config, seed) if spec.simulated else []
    with stop_signals() as stop, open_world(world_plan, devices) as world:
        folder = record or RUNS_FOLDER / f"{config.bench.name}-{utc_stamp()}"
        plan = _recording_plan(config, world, folder, seed, str(spec), view)
        recorder = start_recording(plan)
        if log is not None:
            log.send_to(recorder.fault_block)
        run = _Run(config, world, recorder, stop, progress)
        summary = run.to_the_end()
    return BenchResult(summary.as_json(), summary.verdict.passed, bool(stop), folder)


def _recording_plan(
    config: BenchConfig, world: World, folder: Path, seed: int, bus: str, view: bool
) -> RecordingPlan:
    axes = tuple(
        AxisPlan(name, drive.limits.torque_max_nm / drive.motor.parameters.inertia_kg_m2)
        for name, drive in sorted(config.drive.items())
    )
    first = config.drive[config.axes[0]]
    return RecordingPlan(
        folder=folder,
        name=config.bench.name,
        seed=seed,
        bus=bus,
        real_time=world.real_time,
        deadline=config.loop.deadline,
        review=ReviewPlan(axes, VerdictLimits(**config.verdict.model_dump())),
        bench_toml=config.resolved_text(bus_spec=bus, seed=seed),
        wall_offset=world.wall_offset,
        frames=config.recording.frames,
        faults=config.faults is not None,
        view=view,
        notes={
            "motor": first.motor.motor.name,
            "controller": first.controller.kind,
            "compensator": first.compensator.kind,
            "bus": bus,
        },
    )


class _Run:
    """One run in its world, from connecting to the drives to closing the recording."""

    def __init__(
        self, config: BenchConfig, world: World, recorder: Recorder, stop: StopRequest, progress: Progress
    ) -> None:
        self._config = config
        self._world = world
        self._recorder = recorder
        self._stop = stop
        self._progress = progress
        self._network = CanopenNetwork(world.link, world.clock, config.host.node)
        self._drives = [ServoDrive(self._network, config.drive[name].node, name) for name in config.axes]
        self._load_machines: list[ObjectLoadMachine] = []
        if config.recording.frames:
            world.link.tap(recorder.frame)
            world.tap_errors(recorder.frame)

    def to_the_end(self) -> Summary:
        """Run, bring the drives to rest, close the recording; errors pass through afterwards."""
        outcome = _cut_short("it ended by a defect of this program")
        try:
            outcome = self._run_and_release()
        except BenchError as error:
            outcome = _cut_short(str(error))
            self._recorder.event(self._world.clock.now(), "CRITICAL", str(error))
            raise
        finally:
            if self._world.faults is not None:
                self._world.faults.finish()
            summary = self._recorder.close(outcome)
        return summary

    def _run_and_release(self) -> RunOutcome:
        try:
            return self._run()
        finally:
            self._release()

    def _run(self) -> RunOutcome:
        config, world = self._config, self._world
        timing = assembly.loop_timing(config)
        self._prepare(timing)
        axes = [
            assembly.axis(config, number, drive, self._load_machine(drive), timing, self._recorder)
            for number, drive in enumerate(self._drives)
        ]
        loop = Loop(self._network.frame_pump, world.clock, axes, timing)
        self._enter("enabling")
        for drive in self._drives:
            drive.enable(self._deadline(ENABLE_TIMEOUT_S))
            self._note_state(drive)
        self._enter("calibrating")
        loop.calibrate()
        self._stop.check()
        self._enter("running")
        with self._timing_conditions():
            wall = MonotonicClock()
            began = wall.now()
            ended = self._cycles(loop, timing)
            took = Duration(wall.now() - began)
        return self._outcome(ended, took)

    def _prepare(self, timing: LoopTiming) -> None:
        host = self._config.host
        self._enter("connecting")
        for drive in self._drives:
            identity = drive.connect(self._deadline(host.connect_timeout_s))
            self._say(f"{drive.name}: node {drive.node_id} is {identity}")
            self._stop.check()
        self._enter("configuring")
        for drive in self._drives:
            wanted = self._config.drive[drive.name]
            limits = wanted.limits
            settings = DriveSettings(
                sync_period_ns=timing.period,
                synchronous_command=timing.actuation.value == "on_sync",
                position_every_cycles=self._config.loop.position_every_cycles,
                drive_heartbeat_ms=wanted.heartbeat_ms,
                drive_heartbeat_timeout_ms=wanted.heartbeat_timeout_ms,
                host_heartbeat_ms=host.heartbeat_ms,
                host_heartbeat_timeout_ms=host.heartbeat_timeout_ms,
                torque_max_nm=limits.torque_max_nm,
                speed_max_rad_s=limits.speed_max_rad_s,
                quick_stop_deceleration_rad_s2=limits.quick_stop_deceleration_rad_s2,
            )
            for note in drive.configure(settings):
                self._say(f"{drive.name}: {note}", "WARN")
            self._note_state(drive)
            self._stop.check()

    def _load_machine(self, drive: ServoDrive) -> ObjectLoadMachine | None:
        wanted = bool(self._config.load.get(drive.name))
        machine = find_load_machine(self._network, drive.node_id, self._config.source, drive.name, wanted)
        if machine is not None:
            machine.take_off()
            self._load_machines.append(machine)
        return machine

    @contextmanager
    def _timing_conditions(self) -> Iterator[None]:
        if not self._world.real_time:
            with quiet_garbage_collector():
                yield
            return
        with realtime_process() as refused:
            for request in refused:
                self._say(f"not granted by the kernel: {request}", "WARN")
            yield

    def _cycles(self, loop: Loop, timing: LoopTiming) -> LoopOutcome:
        period_s = timing.period / NS_PER_S
        return loop.run(
            duration_s(self._config.bench.duration_s),
            self._stop,
            self._start,
            lambda done: self._progress("running", done * period_s),
        )

    def _start(self, at: Instant) -> None:
        """The run's time zero: the fault plan and the recording count from here."""
        self._recorder.begin(at)
        if self._world.faults is not None:
            self._world.faults.start(at)
        for name in self._config.axes:
            for when_s, text in _planned_events(self._config, name):
                self._recorder.event(Instant(at + duration_s(when_s)), "INFO", f"{name}: {text}")

    def _outcome(self, ended: LoopOutcome, took: Duration) -> RunOutcome:
        if ended.ticks_missed:
            self._say(f"{ended.ticks_missed} ticks missed", "WARN")
        if ended.interrupted:
            self._say(f"ended by {self._stop.signal_name}", "WARN")
        bench_time = ended.ended_at - ended.started_at
        return RunOutcome(
            bus_load_percent=self._world.load_percent(ended.started_at, ended.ended_at),
            realtime_factor=bench_time / max(took, 1),
            completed=not ended.interrupted,
            reason=f"ended by {self._stop.signal_name}" if ended.interrupted else "",
        )

    def _release(self) -> None:
        """Every way out of a run leads through here."""
        self._enter("stopping")
        if errors := self._world.error_frames():
            self._say(f"{errors} error frames on the bus", "WARN")
        if self._world.faults is not None:
            self._world.faults.stop()
        for drive in self._drives:
            release = drive.release()
            self._note_state(drive)
            if not release.at_rest:
                self._say(f"{drive.name}: not confirmed at rest: {release.evidence}", "ERROR")
        for machine in self._load_machines:
            try:
                machine.take_off()
            except PeerFault as error:
                self._say(f"the load may still be on: {error}", "ERROR")
        self._progress("stopped", self._config.bench.duration_s)

    def _deadline(self, timeout_s: float) -> Instant:
        return self._network.deadline_after(duration_s(timeout_s))

    def _enter(self, phase: str) -> None:
        self._progress(phase, 0.0)
        self._recorder.state(self._world.clock.now(), "phase", phase)

    def _note_state(self, drive: ServoDrive) -> None:
        state = drive.state
        label = "unknown" if state is None else state.value
        self._recorder.state(self._world.clock.now(), f"{drive.name} drive", label)

    def _say(self, text: str, level: str = "INFO") -> None:
        self._recorder.event(self._world.clock.now(), level, text)


def _cut_short(reason: str) -> RunOutcome:
    return RunOutcome(bus_load_percent=0.0, realtime_factor=0.0, completed=False, reason=reason)


def _planned_events(config: BenchConfig, axis: str) -> list[tuple[float, str]]:
    events = [
        (segment.at_s, f"reference {_described(segment)}") for segment in config.reference.get(axis, ())
    ]
    events += [(step.at_s, f"load torque {step.torque_nm:g} N m") for step in config.load.get(axis, ())]
    return sorted(events)


def _described(segment: Reference) -> str:
    if isinstance(segment, StepReference):
        return f"step to {segment.speed_rpm:g} r/min"
    if isinstance(segment, RampReference):
        return f"ramp to {segment.speed_rpm:g} r/min over {segment.over_s:g} s"
    return f"sine of {segment.amplitude_rpm:g} r/min at {segment.frequency_hz:g} Hz"
