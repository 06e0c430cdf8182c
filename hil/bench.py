"""A whole run: the bus, the drives, the loop, the recording, and a safe end whatever happens in between."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.adapters import parse_bus_spec
from drivers.dictionary import LoadedDictionary
from drivers.errors import BenchError, PeerFault
from drivers.network import CanopenNetwork
from drivers.pdo import DONE
from drivers.servo import ServoDrive
from drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock, duration_s, utc_stamp
from hil import assembly
from hil.axis import Axis
from hil.commissioned_drive import as_the_loop_counts, write_commissioned
from hil.configuration.config import BenchConfig
from hil.configuration.quantities import odd_values
from hil.connecting import connect
from hil.controllers import Controller
from hil.drive_settings import data_sheets, drive_settings, identity_notes
from hil.figures.summary import RunOutcome, Summary
from hil.load_machines import LoadMachines
from hil.loop import Loop, LoopOutcome, LoopTiming
from hil.machine.realtime import timing_conditions
from hil.machine.stopping import StopRequest, stop_signals
from hil.network_guard import NetworkGuard, WorseNetwork, allowed, made_for, worse_network
from hil.pace import OwnSync, Pace
from hil.recording.fault_report import write_fault_report
from hil.recording.logger_process import RecordingFailed
from hil.recording.recorder import Recorder, start_recording
from hil.recording.watch import RecordingWatch
from hil.samples import CycleRecord
from hil.segments import heard_syncs, masters, record_frames, sync_log
from hil.simulated_drives import simulated_drives
from hil.sync_source import SyncSource, check_sync_source, kernel_sync
from hil.syncs import SyncLog
from hil.terminal.progress import Progress
from hil.timing_report import distrust, timing_report
from hil.world import World, WorldPlan, check_time, open_world
from virtual_bus.fault_injection.fault_log import FaultLog
from virtual_bus.servo import SimulatedServo

ENABLE_TIMEOUT_S = 2.0
RUNS_FOLDER = Path("runs")


@dataclass(frozen=True, slots=True)
class BenchResult:
    """What a run came to."""

    summary: dict[str, Any]
    """What ``hil run --json`` prints."""
    passed: bool
    interrupted: bool
    """A stop signal cut it short."""
    recorded: bool
    """The recording is whole, or none was asked for."""
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
    keep: bool = True,
    controllers: Mapping[str, Controller] | None = None,
    network: Path | None = None,
    allow_worse_network: bool = False,
    privileged: bool = True,
) -> BenchResult:
    """Run a bench and review it.

    ``bus_spec``, ``time``, ``seed``: what the command line puts in place of the file's. ``record``: folder of
    the recording, else one under ``runs``; no file is kept unless ``keep``. ``controllers``: by axis, what a
    caller puts in place of the file's. ``network``: file of one measured before, that must be no worse than
    the controllers were made for; nor may the run's own, unless ``allow_worse_network``. ``privileged``: ask
    the kernel for real-time priority and locked memory on a bus in real time.
    Raises BadInput before anything moves, PeerFault if bus or drive failed, RecordingFailed if the recording
    did; in every case the drives are brought to rest and the recording is closed first.
    """
    sheets = data_sheets(config)
    worse = worse_network(config, network, allow_worse_network, set(controllers or {}))
    spec = parse_bus_spec(bus_spec or config.bus.spec, "--bus" if bus_spec else config.source)
    paced = check_time(spec, time)
    check_sync_source(config, spec)
    seed = config.bench.seed if seed is None else seed
    log = FaultLog() if config.fault_plan is not None else None
    background = tuple(entry.stream for entry in config.bus.background)
    world_plan = WorldPlan(
        spec,
        config.bus.bitrate_bit_s,
        paced,
        config.fault_plan,
        seed,
        fault_log=log,
        background=background,
        segments=assembly.segment_plans(config),
    )
    devices = simulated_drives(config, seed) if spec.simulated else []
    with stop_signals() as stop, open_world(world_plan, devices) as world:
        folder = (record or RUNS_FOLDER / f"{config.bench.name}-{utc_stamp()}") if keep else None
        plan = assembly.recording_plan(config, world, folder, seed, str(spec), view)
        recorder = start_recording(plan)
        if log is not None:
            log.send_to(recorder.fault_block)
        run = _Run(config, world, recorder, stop, progress, controllers or {}, worse, devices, sheets)
        with timing_conditions(world.real_time and privileged) as refused:
            try:
                summary = run.to_the_end(refused)
            except PeerFault as error:
                if folder is not None:
                    run.write_fault_report(folder, str(error))
                raise
    interrupted = stop() and not summary.verdict.completed
    recorded = not summary.recording_faults
    return BenchResult(summary.as_json(), summary.verdict.passed, interrupted, recorded, folder)


class _Run:
    """One run in its world, from connecting to the drives to closing the recording."""

    def __init__(
        self,
        config: BenchConfig,
        world: World,
        recorder: Recorder,
        stop: StopRequest,
        progress: Progress,
        controllers: Mapping[str, Controller],
        worse: WorseNetwork,
        servos: Sequence[SimulatedServo],
        sheets: Mapping[str, LoadedDictionary],
    ) -> None:
        self._config = config
        self._world = world
        self._recorder = recorder
        self._watch = RecordingWatch(recorder, config.recording.on_failure == "continue", progress, self._say)
        self._stop = stop
        self._progress = progress
        self._controllers = controllers
        self._worse = worse
        self._sheets = sheets
        self._network = CanopenNetwork(world.link, world.clock, config.host.node)
        self._networks, self._master = masters(self._network, world)
        self._sync_source = SyncSource(config.loop.sync)
        self._axes: list[Axis] = []
        self._syncs: dict[str, SyncLog] = {}
        self._drives = [
            ServoDrive(self._networks[config.drive[name].segment], config.drive[name].node, name)
            for name in config.axes
        ]
        self._load = LoadMachines(config, self._network, recorder, servos)
        if config.recording.frames:
            record_frames(world, recorder.tap)

    def to_the_end(self, refused: Sequence[str]) -> Summary:
        """Run, bring the drives to rest, close the recording; errors pass through afterwards.

        ``refused``: what the kernel did not grant, in words.
        """
        for request in refused:
            self._say(f"not granted by the kernel: {request}", "WARN")
        try:
            outcome = self._run_and_release()
        except BenchError as error:
            self._say(str(error), "CRITICAL")
            with suppress(RecordingFailed):  # what ended the run is to be told
                self._close(_cut_short(str(error)))
            raise
        except BaseException:
            self._close(_cut_short("it ended by a defect of this program"))
            raise
        return self._close(outcome)

    def _close(self, outcome: RunOutcome) -> Summary:
        if self._world.faults is not None:
            self._world.faults.finish()
        return self._recorder.close(outcome)

    def write_fault_report(self, folder: Path, error: str) -> None:
        """Beside the recording, which is closed: what was seen before the end."""
        makes = {drive.node_id: drive.control.make for drive in self._drives}
        told = sorted({e for drive in self._drives for e in drive.network.emergencies}, key=lambda e: e.at)
        write_fault_report(folder, error, told, makes, self._world.clock.now())

    def _run_and_release(self) -> RunOutcome:
        try:
            return self._run()
        finally:
            self._release()

    def _run(self) -> RunOutcome:
        config, world = self._config, self._world
        timing = assembly.loop_timing(config)
        self._prepare(timing)
        syncs, pace = self._listen_for_syncs(timing)
        self._syncs = {segment or str(world.link.name): log for segment, log in syncs.items()}
        axes = [
            assembly.axis(
                config,
                number,
                as_the_loop_counts(drive, config.drive[drive.name].commissioned),
                drive.reading_bytes,
                self._load.find(drive, self._say),
                timing,
                syncs[config.drive[drive.name].segment],
                self._watched(drive),
                self._teller(drive),
                own,
            )
            for number, drive in enumerate(self._drives)
            for own in [self._controllers.get(drive.name)]
        ]
        self._axes = axes
        loop = Loop(self._master, world.clock, axes, pace, timing, self._load.chore)
        with self._sync_producer(timing):
            return self._calibrate_and_run(loop, timing)

    def _listen_for_syncs(self, timing: LoopTiming) -> tuple[dict[str | None, SyncLog], Pace]:
        """The SYNCs of each segment, and what starts the cycles."""
        config, world = self._config, self._world
        stall = None if world.faults is None else world.faults.host_stall
        if self._sync_source is not SyncSource.OWN:
            log, heard = heard_syncs(self._network, world.clock, timing.period, stall)
            return {None: log}, heard
        syncs = {
            segment: sync_log(network, assembly.sync_latency(config, segment), timing.period)
            for segment, network in self._networks.items()
        }
        return syncs, OwnSync(self._master, world.clock, timing.period, list(syncs.values()), stall)

    def _sync_producer(self, timing: LoopTiming) -> AbstractContextManager[None]:
        """Who makes SYNCs on behalf of this process, as long as it is entered."""
        if self._sync_source is SyncSource.KERNEL:
            return kernel_sync(self._world.link.bus, timing.period)
        return nullcontext()

    def _calibrate_and_run(self, loop: Loop, timing: LoopTiming) -> RunOutcome:
        self._enter("calibrating")
        loop.calibrate()
        self._stop.check()
        self._enter("enabling")
        self._watch.confirm(self._network)
        for drive in self._drives:
            drive.enable(self._deadline(ENABLE_TIMEOUT_S))
            self._note_state(drive)
            self._tell_guard(drive)
        self._stop.check()
        self._enter("running")
        wall = MonotonicClock()
        began = wall.now()
        ended = self._cycles(loop, timing)
        took = Duration(wall.now() - began)
        return self._outcome(ended, took)

    def _prepare(self, timing: LoopTiming) -> None:
        host = self._config.host
        for note in (*self._worse.notes, *odd_values(self._config)):
            self._say(note, "WARN")
        self._enter("connecting")
        for drive in self._drives:
            identity = connect(drive, host.connect_timeout_s, self._stop)
            self._say(f"{drive.name}: node {drive.node_id} is {identity}")
            if (sheet := self._sheets.get(drive.name)) is not None:
                for note in identity_notes(identity, sheet, drive.node_id):
                    self._say(f"{drive.name}: {note}", "WARN")
            self._stop.check()
        self._enter("configuring")
        for drive in self._drives:
            sheet = self._sheets.get(drive.name)
            settings = drive_settings(self._config, drive.name, timing, sheet)
            commissioned = self._config.drive[drive.name].commissioned
            if commissioned is not None:
                write_commissioned(drive, commissioned)
            for note in drive.configure(settings):
                self._say(f"{drive.name}: {note}", "INFO" if note.endswith(DONE) else "WARN")
            self._note_state(drive)
            self._stop.check()

    def _cycles(self, loop: Loop, timing: LoopTiming) -> LoopOutcome:
        period_s = timing.period / NS_PER_S
        return loop.run(
            duration_s(self._config.bench.duration_s),
            self._stop,
            self._start,
            lambda done: self._watch.attend(done * period_s),
        )

    def _start(self, at: Instant) -> None:
        """The run's time zero: the fault plan and the recording count from here."""
        self._recorder.begin(at)
        self._load.begin(at)
        if self._world.faults is not None:
            self._world.faults.start(at)
        for name in self._config.axes:
            for when_s, text in assembly.planned_events(self._config, name):
                self._recorder.event(Instant(at + duration_s(when_s)), "INFO", f"{name}: {text}")

    def _outcome(self, ended: LoopOutcome, took: Duration) -> RunOutcome:
        if ended.cycles_missed:
            own = self._sync_source is SyncSource.OWN
            why = "the host was too late for it" if own else "it was not heard, or not in time"
            self._say(f"{ended.cycles_missed} cycles went without SYNC: {why}", "WARN")
        if ended.interrupted:
            self._say(f"ended by {self._stop.signal_name}", "WARN")
        doubts = distrust(self._axes, self._config.loop.period)
        for doubt in doubts:
            self._say(f"not trustworthy: {doubt}", "ERROR")
        bench_time = ended.ended_at - ended.started_at
        return RunOutcome(
            bus_load_percent=self._world.load_percent(ended.started_at, ended.ended_at),
            realtime_factor=bench_time / max(took, 1),
            completed=not ended.interrupted,
            reason=f"ended by {self._stop.signal_name}" if ended.interrupted else "",
            network_notes=self._worse.notes,
            load_machine=self._load.figures(),
            timing=timing_report(self._axes, self._syncs),
            distrust=doubts,
        )

    def _tell_guard(self, drive: ServoDrive) -> None:
        """From now on somebody notices when the drive does not hear its commands any more."""
        guard = drive.supervise_commands()
        level = "INFO" if drive.supervision.active else "WARN"
        self._say(f"{drive.name}: its commands are watched by {guard}", level)

    def _teller(self, drive: ServoDrive) -> Callable[[str], None]:
        return lambda text: self._say(f"{drive.name}: {text}", "WARN")

    def _watched(self, drive: ServoDrive) -> Callable[[CycleRecord], None]:
        """Where the records of an axis go: past a guard, if its controller was made for a network."""
        wanted = made_for(self._config.drive[drive.name])
        if wanted is None or drive.name in self._controllers:
            return self._recorder.record
        period = self._config.loop.period
        limits = allowed(wanted, period)
        return NetworkGuard(
            drive.name,
            limits,
            period,
            self._recorder.record,
            self._worse.refuse,
            self._note_network,
            self._stop,
        )

    def _note_network(self, text: str) -> None:
        self._worse.notes.append(text)
        self._say(text, "WARN")

    def _release(self) -> None:
        """Every way out of a run leads through here."""
        self._enter("stopping")
        self._load.let_go(self._say)
        if errors := self._world.error_frames():
            self._say(f"{errors} error frames on the bus", "WARN")
        if trouble := self._world.trouble():
            self._say(trouble, "WARN")
        if self._world.faults is not None:
            self._world.faults.stop()
        for drive in self._drives:
            # Of all of them, before the first is let go: the others' commands cease meanwhile.
            drive.supervision.end()
        for drive in self._drives:
            release = drive.release()
            self._note_state(drive)
            if not release.at_rest:
                self._say(f"{drive.name}: not confirmed at rest: {release.evidence}", "ERROR")
        self._load.take_off(self._say)
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
