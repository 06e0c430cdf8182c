"""A whole run: the bus, the drives, the loop, the recording, and a safe end in every case."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import DONE
from servobench.drivers.cia402.follow_watch import Lapse
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.state_control import FAULTY
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BenchError, PeerFault
from servobench.drivers.sheets.dictionary import LoadedDictionary
from servobench.drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock, duration_s, utc_stamp
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_checks import idle_faults
from servobench.hil.configuration.quantities import odd_values
from servobench.hil.execution import assembly, segments
from servobench.hil.execution.assembly import AxisCode, axis_code, check_axes
from servobench.hil.execution.conclusion import Conclusion, Standstill, distrust, made_twice, timing_report
from servobench.hil.execution.drive_session import (
    DriveSession,
    connect,
    data_sheets,
    drive_settings,
    identity_notes,
    stop_each,
    write_commissioned,
)
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.execution.recorded_bench import keep_files, recording_plan
from servobench.hil.execution.world import World, WorldPlan, check_time, open_world
from servobench.hil.load.load_machines import LoadMachines
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.loop import Loop, LoopOutcome, LoopTiming, planned_cycles
from servobench.hil.loop.protocol import Controller
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.machine.progress import Progress, no_progress
from servobench.hil.machine.realtime import timing_conditions
from servobench.hil.machine.stopping import StopRequest, stop_signals
from servobench.hil.recording.fault_report import write_fault_report
from servobench.hil.recording.logger_process import RecordingWatch
from servobench.hil.recording.recorder import new_folder, recorder_of
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.hil.rows.recording_plan import RecordingPlan, ServedPorts
from servobench.hil.verdict.summary import Summary
from servobench.hil.write_lists import RUN
from servobench.virtual_bus.faults.fault_log import FaultLog

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import SimulatedServo

RUNS_FOLDER = Path("runs")


def run_bench(
    config: BenchConfig,
    *,
    bus_spec: str | None = None,
    time: str | None = None,
    seed: int | None = None,
    record: Path | None = None,
    view: bool = False,
    served: ServedPorts | None = None,
    progress: Progress = no_progress,
    keep: bool = True,
    controllers: Mapping[str, Controller] | None = None,
    network: Path | None = None,
    allow_uncertified: bool = False,
    privileged: bool = True,
    stop: StopRequest | None = None,
    recording: Callable[[RecordingPlan], RunRecorder] = recorder_of,
    concluded: Callable[[Summary], None] = lambda _summary: None,
) -> Summary:
    """Run a bench and review it; from any thread.

    ``bus_spec``, ``time``, ``seed``: override those in the file. ``record``: its folder, by default one under
    ``runs``; none unless ``keep``. ``controllers``: by axis, in place of the file's. ``network``: file of an
    earlier measurement, with the stamps' resolution. That network, the run's own and the drives must match
    the controllers' certificates, unless ``allow_uncertified``. ``privileged``: with real-time priority and
    locked memory. ``stop``: asks for the end, as a stop signal does. ``recording``: starts a recorder. Raises
    BadInput before anything moves, PeerFault if bus or drive failed, RecordingFailed if the recording did;
    after the drives are at rest, and ``concluded`` is given the summary in any case.
    """
    check_axes(config, controllers := controllers or {})
    sheets = data_sheets(config)
    spec = parse_bus_spec(bus_spec or config.bus.spec, "--bus" if bus_spec else config.source)
    config = config.as_run(str(spec), seed, network)
    certificates = Certificates(config, controllers)
    certificates.check(network, allow_uncertified)
    paced = check_time(spec, time, served is not None)
    segments.check_sync_source(config, spec)
    code = axis_code(config, controllers, real_time=paced or not config.simulated)
    timing, devices = assembly.loop_timing(config), assembly.simulated(config)
    log = FaultLog() if config.faults is not None else None
    world_plan = WorldPlan.of_bench(config, spec, paced, log)
    with stop_signals(stop) as asked, open_world(world_plan, devices) as world:
        folder = record or new_folder(RUNS_FOLDER / f"{config.bench.name}-{utc_stamp()}") if keep else None
        plan = replace(
            recording_plan(config, folder, code, certificates.plans(), real_time=world.real_time),
            started_at=world.clock.now(),
            wall_offset=world.wall_offset,
            view=view,
            served=served,
        )
        recorder = recording(plan)
        if folder is not None:
            keep_files(config, code, folder)
        if log is not None:
            log.send_to(recorder.fault_block)
        planned = planned_cycles(duration_s(config.bench.duration_s), config.loop.period)
        conclusion = Conclusion(config.axes, config.faults, planned)
        with conclusion.explaining(lambda: concluded(recorder.close(conclusion.outcome))):
            run = _Run(
                config, timing, world, recorder, conclusion, asked, progress, code, certificates, devices,
                sheets,
            )  # fmt: skip
        with timing_conditions(world.real_time, privileged) as refused:
            try:
                return run.to_the_end(refused, concluded)
            except PeerFault as error:
                if folder is not None:
                    run.write_fault_report(folder, str(error))
                raise


@dataclass
class _Run:
    """One run in its world, from connecting to the drives to closing the recording."""

    config: BenchConfig
    timing: LoopTiming
    world: World
    recorder: RunRecorder
    conclusion: Conclusion
    stop: StopRequest
    progress: Progress
    code: Mapping[str, AxisCode]
    certificates: Certificates
    servos: "Sequence[SimulatedServo]"
    sheets: Mapping[str, LoadedDictionary]
    _axes: list[Axis] = field(default_factory=list, init=False)
    _enabled_from: Instant | None = field(default=None, init=False)
    _zero: Instant | None = field(default=None, init=False)
    _syncs: dict[str, SyncLog] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        config, world, recorder = self.config, self.world, self.recorder
        goes_on = config.recording.on_failure == "continue"
        self._standstill = Standstill(world, config.loop.period, self._say)
        self._watch = RecordingWatch(recorder, goes_on, self.progress, self._say)
        self._network = CanopenNetwork(world.link, world.clock, config.host.node, writes=RUN)
        self._networks, self._master = segments.masters(self._network, world)
        self._drives = [
            ServoDrive(self._networks[config.drive[name].segment], config.drive[name].node, name)
            for name in config.axes
        ]
        self._session = DriveSession(
            world,
            self._networks,
            self._drives,
            config.guard,
            recorder.event,
            own_sync=config.loop.sync == "own",
            repeated=made_twice(config.faults),
        )
        self._load = LoadMachines(config, self._network, recorder, self.servos)
        world.tell_troubles(recorder.event)
        assembly.tell_changes(config, self.servos, recorder)
        if config.recording.frames:
            segments.record_frames(world, recorder.tap)

    def to_the_end(self, refused: Sequence[str], concluded: Callable[[Summary], None]) -> Summary:
        """Run, bring the drives to rest, close the recording; errors pass through afterwards.

        ``refused``: requests refused by the kernel, in words.
        """
        for request in refused:
            self._say(f"not granted by the kernel: {request}", "WARN")
        with self.conclusion.explaining(lambda: self._close(concluded)), self.world.settings_told():
            self._run_and_release()
            self.conclusion.came_to_its_end()
        return self._close(concluded)

    def _close(self, concluded: Callable[[Summary], None]) -> Summary:
        self.world.faults.finish()
        summary = self.recorder.close(self.conclusion.outcome)
        concluded(summary)
        return summary

    def write_fault_report(self, folder: Path, error: str) -> None:
        """Write the frames and events before the end into the closed recording's folder."""
        makes = {drive.node_id: drive.control.make for drive in self._drives}
        sent = sorted({e for drive in self._drives for e in drive.network.emergencies}, key=lambda e: e.at)
        write_fault_report(folder, error, sent, makes, self.world.clock.now())

    def _run_and_release(self) -> None:
        try:
            self._run()
        except BenchError as error:
            self._tell_end(self.world.explained(error, self._standstill.cure()))
            raise
        finally:
            self._release()

    def _tell_end(self, error: BenchError) -> None:
        """Record the cause of the end and the states of the drives, each at its own instant."""
        seen_at = error.seen_at if isinstance(error, PeerFault) else None
        self.recorder.event(seen_at or self.world.clock.now(), "CRITICAL", str(error))
        for drive in self._drives:
            self._note_state(drive, drive.control.fault_seen_at if drive.state in FAULTY else None)

    def _run(self) -> None:
        config, world, timing = self.config, self.world, self.timing
        self._prepare()
        syncs, pace = segments.listen_for_syncs(config, world, self._networks, self._master, timing.period)
        self._syncs = {segment or str(world.link.name): log for segment, log in syncs.items()}
        warn = partial(self._say, level="WARN")
        self._axes = [
            assembly.axis(
                config,
                number,
                drive,
                self.code[drive.name],
                self._load.find(drive, self._say),
                timing,
                syncs[config.drive[drive.name].segment],
                self.certificates.watched(drive.name, self.recorder.record, warn, self.stop),
                self._teller(drive),
            )
            for number, drive in enumerate(self._drives)
        ]
        loop = self._session.cycle(
            self._master, self._axes, pace, timing, syncs,
            delays_of=self._axes, bench=config.drive, chore=self._load.chore,
        )  # fmt: skip
        with segments.sync_producer(config.loop.sync, world.link.bus, timing.period):
            self._calibrate_and_run(loop)

    def _calibrate_and_run(self, loop: Loop) -> None:
        self._enter("calibrating")
        loop.calibrate()
        self.stop.check()
        self._enter("enabling")
        self._watch.confirm(self._network)
        self._enabled_from = self.world.clock.now()
        for drive in self._drives:
            self._session.enable(drive)
            self._note_state(drive)
            self._tell_guard(drive)
        self.stop.check()
        self._load.begin_with_next_sync()
        self._enter("running")
        began = MonotonicClock().now()
        ended = loop.run(
            duration_s(self.config.bench.duration_s),
            self.stop,
            self._start,
            lambda done: self._note_progress(done * self.timing.period / NS_PER_S),
        )
        self._note_ended(ended, Duration(MonotonicClock().now() - began))
        if not ended.interrupted:
            self.conclusion.look_at(self._drives)

    def _prepare(self) -> None:
        for note in (
            *self.certificates.notes,
            *self.certificates.doubts(),
            *odd_values(self.config),
            *idle_faults(self.config),
        ):
            self._say(note, "WARN")
        for axis, code in self.code.items():
            for key, kept in code.own.items():
                self._say(f"{axis}: {key} {kept.name}, BLAKE2b {kept.digest}")
        self._enter("connecting")
        for drive in self._drives:
            identity = connect(drive, self.config.host.connect_timeout_s, self.stop)
            self._say(f"{drive.name}: node {drive.node_id} is {identity}")
            self.recorder.identity(self.world.clock.now(), drive.name, str(identity))
            if (sheet := self.sheets.get(drive.name)) is not None:
                for note in identity_notes(identity, sheet):
                    self._say(f"{drive.name}: {note}", "WARN")
            self.stop.check()
        self._enter("configuring")
        for drive in self._drives:
            settings = drive_settings(self.config, drive.name, self.timing, self.sheets.get(drive.name))
            if (commissioned := self.config.drive[drive.name].commissioned) is not None:
                write_commissioned(drive, commissioned, simulated=self.config.simulated)
            notes = drive.configure(settings)
            self._note_state(drive)
            for note in notes:
                self._say(f"{drive.name}: {note}", "INFO" if note.endswith(DONE) else "WARN")
            self.stop.check()

    def _note_progress(self, time_s: float) -> None:
        self._watch.attend(time_s)
        self._standstill.attend()
        self.world.faults.finish()

    def _start(self, at: Instant) -> None:
        """Start the run's time zero: the fault plan and the recording count from here."""
        self._zero = at
        self.recorder.begin(at)
        self._load.begin(at)
        self.world.faults.start(at)

    def _note_ended(self, ended: LoopOutcome, took: Duration) -> None:
        if ended.cycles_missed:
            own = self.config.loop.sync == "own"
            why = "host or adapter was too late for it" if own else "it was not heard, or not in time"
            self._say(f"{ended.cycles_missed} cycles went without SYNC: {why}", "WARN")
        if reason := f"ended by {self.stop.asked_by}" if ended.interrupted else "":
            self._say(reason, "WARN")
        for doubt in (doubts := distrust(self._axes, self.config.loop.period)):
            self._say(f"not trustworthy: {doubt}", "ERROR")
        self.conclusion.ended(
            ended,
            reason,
            self.timing.period,
            self.config.loop.horizon,
            bus_load_percent=self.world.load_percent(ended.started_at, ended.ended_at),
            realtime_factor=(ended.ended_at - ended.started_at) / max(took, 1),
            network_notes=self.certificates.notes,
            load_machine=self._load.figures(),
            timing=timing_report(self._axes, self._syncs, self._session.guard.counts),
            distrust=doubts,
        )

    def _tell_guard(self, drive: ServoDrive) -> None:
        """Report the supervision that now detects a drive deaf to its commands."""
        guard, active = drive.supervise_commands(), drive.supervision.active
        self._say(f"{drive.name}: its commands are watched by {guard}", "INFO" if active else "WARN")
        drive.watch.on_mode_watch = partial(self._tell_mode_watch, drive)
        self._tell_mode_watch(drive)
        drive.follow.on_change = partial(self._tell_lapse, drive)
        drive.watch.stop_first = partial(stop_each, self._drives)

    def _tell_mode_watch(self, drive: ServoDrive) -> None:
        watch, level = drive.watch.mode_watch, "INFO" if drive.watch.sees_mode else "WARN"
        self._say(f"{drive.name}: its mode is watched by {watch}", level)
        self.conclusion.watched(drive, watch)

    def _tell_lapse(self, drive: ServoDrive, lapse: Lapse) -> None:
        if lapse.ended_at is None:
            self.recorder.event(lapse.began_at, "ERROR", f"{drive.name} {lapse}: {lapse.evidence}")
        else:
            self.recorder.event(lapse.ended_at, "WARN", f"{drive.name} follows {lapse.mode.title} again")

    def _teller(self, drive: ServoDrive) -> Callable[[str], None]:
        return lambda text: self._say(f"{drive.name}: {text}", "WARN")

    def _release(self) -> None:
        """Release the drives: every way out of a run leads through here."""
        self._enter("stopping")
        if errors := self.world.error_frames():
            self._say(f"{errors} error frames on the bus", "WARN")
        if trouble := self.world.trouble():
            self._say(trouble, "WARN")
        # A disabled drive holds no shaft against a load.
        self._session.let_go(self._drives, self._note_release, unload=lambda: self._load.take_off(self._say))
        if self._enabled_from is not None:
            for drive in self._drives:
                self.conclusion.told(drive, self._enabled_from, self._zero)
        self.conclusion.disturbed(self._session.end(self._zero))
        self.progress("stopped", self.config.bench.duration_s)

    def _note_release(self, drive: ServoDrive, release: Release) -> None:
        self.conclusion.released(drive, release)
        if release.rested_at is not None:
            self.recorder.event(release.rested_at, "INFO", f"{drive.name}: at rest")
        self._note_state(drive)
        trouble = release.unwatched if release.at_rest else f"not confirmed at rest: {release.evidence}"
        if trouble:
            self._say(f"{drive.name}: {trouble}", "ERROR")

    def _enter(self, phase: str) -> None:
        self.progress(phase, 0.0)
        self.recorder.state(self.world.clock.now(), "phase", phase)

    def _note_state(self, drive: ServoDrive, seen_at: Instant | None = None) -> None:
        """Note a drive's state. ``seen_at``: when it showed; None: with its statusword."""
        at = seen_at or drive.control.status_told_at or self.world.clock.now()
        label = "unknown" if drive.state is None else drive.state.value
        self.recorder.state(at, f"{drive.name} drive", label)

    def _say(self, text: str, level: str = "INFO") -> None:
        self.recorder.event(self.world.clock.now(), level, text)
