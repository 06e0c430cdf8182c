"""A whole measurement: from the first frame to the figures, with the drives restored."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BadInput, BenchError, PeerFault
from servobench.drivers.timebase import NS_PER_S, Duration, Instant, utc_stamp
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.configuration.config import Guard
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.bench import RUNS_FOLDER
from servobench.hil.execution.conclusion import distrust, made_twice, timing_report
from servobench.hil.execution.drive_session import DriveSession, connect
from servobench.hil.execution.segments import sync_log
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.loop import LoopOutcome
from servobench.hil.loop.pace import OwnSync
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.machine.progress import Progress
from servobench.hil.machine.realtime import timing_conditions
from servobench.hil.machine.stopping import StopRequest, stop_signals
from servobench.hil.measuring import stages
from servobench.hil.measuring.figures import ClockFigures, Measured, MeasuredDrive, clocks_by_node, network_of
from servobench.hil.measuring.loss_model import Outcomes, losses_of
from servobench.hil.measuring.stages import TimedDemandChange, acting
from servobench.hil.measuring.subject import MeasureRequest, Subject, affordable, timing_of
from servobench.hil.restoring.journal import Journal, JournaledNetwork, restore_command
from servobench.hil.restoring.restore import head_of, restore
from servobench.hil.rows.records import Rows
from servobench.hil.write_lists import MEASURE
from servobench.virtual_bus.device.canopen_device import CanopenDevice

CONNECT_LIMIT_S: Final = 5.0
"""A device that was just switched on boots in a second or two."""

Say = Callable[[str], None]


def run_measurement(request: MeasureRequest, say: Say, progress: Progress) -> Measured:
    """Measure on the bus of the request; the drives of a simulated one are made here.

    Raises BadInput for a request that does not fit the bus, otherwise as :meth:`Measurement.to_the_end`.
    """
    spec = parse_bus_spec(request.bus, "--bus")
    if request.motor is not None and not spec.simulated:
        raise BadInput("--motor", "", request.bus, "the bus 'simulated': other drives have their own motors")
    devices: Sequence[CanopenDevice] = ()
    if spec.simulated:
        # A host of other drives does without them.
        from servobench.hil.execution.simulated_drives import drive_parameters
        from servobench.virtual_bus.drive.servo import SimulatedServo

        motor, drive = request.motor or LING2012.parameters, drive_parameters(())
        devices = [SimulatedServo(node, motor, drive, request.seed) for node in request.nodes]
    plan = WorldPlan(spec, request.bitrate_bit_s, faults=request.faults, seed=request.seed)
    folder = RUNS_FOLDER / f"measure-{utc_stamp()}"
    with (
        stop_signals() as stop,
        open_world(plan, devices) as world,
        timing_conditions(world.real_time) as refused,
    ):
        for wish in refused:
            say(f"not granted by the kernel: {wish}")
        return Measurement(request, world, stop, folder, say, progress).to_the_end()


class Measurement:
    """One measurement, in its world."""

    def __init__(
        self,
        request: MeasureRequest,
        world: World,
        stop: StopRequest,
        folder: Path,
        say: Say,
        progress: Progress,
    ) -> None:
        """``folder``: place of the journals, deleted once everything is restored; ``say``: notifies the
        user."""
        self._request = request
        self._world = world
        self._stop = stop
        self._folder = folder
        self._say = say
        self._progress = progress
        self._network = JournaledNetwork(world.link, world.clock, MEASURE)
        self._subjects = [
            Subject(ServoDrive(self._network, node), world.clock, request) for node in request.nodes
        ]
        drives = [subject.drive for subject in self._subjects]
        self._session = DriveSession(
            world,
            {None: self._network},
            drives,
            Guard(allow=request.allow),
            self._tell,
            repeated=made_twice(request.faults),
        )
        world.tell_troubles(self._tell)
        self._disturbances: tuple[str, ...] = ()
        self._axes: list[Axis] = []
        self._timing = timing_of(request)

    def to_the_end(self) -> Measured:
        """Measure. In every case the drives are brought to rest and restored before this returns.

        Raises BadInput for a request beyond the drives, PeerFault if bus or drives failed or could not be
        restored, Interrupted for an end before the first cycle.
        """
        with self._world.settings_told():
            try:
                outcome, syncs = self._run()
            except BaseException as error:
                if isinstance(error, BenchError):
                    self._world.explained(error)
                self._leave()
                raise
        failures = self._leave()
        if failures:
            raise PeerFault("not everything is as it was", "; ".join(failures))
        self._progress("evaluating", self._seconds(outcome.cycles))
        return self._evaluated(outcome, syncs)

    # ---- the run --------------------------------------------------------------------------------------

    def _run(self) -> tuple[LoopOutcome, SyncLog]:
        request, timing, world = self._request, self._timing, self._world
        changes, every = affordable(request)
        self._progress("connecting", 0.0)
        for subject in self._subjects:
            identity = connect(subject.drive, CONNECT_LIMIT_S, self._stop)
            subject.identity = str(identity)
            subject.find_stamp(self._network)
            node = subject.drive.node_id
            head = head_of(subject.drive.objects, request.bus, request.bitrate_bit_s, identity)
            self._network.begin_journal(Journal(self._folder / f"node{node}.jsonl", head))
        self._progress("configuring", 0.0)
        for subject in self._subjects:
            subject.configure(changes=changes, every=every)
            self._stop.check()
        syncs = sync_log(self._network, timing.sync_latency, timing.period)
        self._axes = [subject.join(number, syncs, self._say) for number, subject in enumerate(self._subjects)]
        pump = self._network.frame_pump
        pace = OwnSync(pump, world.clock, timing.period, [syncs], world.faults.host_stall)
        loop = self._session.cycle(pump, self._axes, pace, timing, {None: syncs}, delays_of=self._axes)
        self._progress("calibrating", 0.0)
        loop.calibrate()
        self._stop.check()
        if request.enable:
            self._enable()
        for subject in self._subjects:
            subject.probe.begin()
        duration = Duration(request.cycles * timing.period)
        outcome = loop.run(
            duration,
            self._stop,
            world.faults.start,
            lambda done: self._progress("measuring", self._seconds(done)),
        )
        return outcome, syncs

    def _tell(self, _at: Instant, _level: str, text: str) -> None:
        """Report an observation of the guard."""
        self._say(text)

    def _enable(self) -> None:
        self._progress("enabling", 0.0)
        for subject in self._subjects:
            drive = subject.drive
            self._session.enable(drive)
            subject.notes.append(f"commands are watched by {drive.supervise_commands()}")
            subject.notes.append(f"its mode is watched by {drive.watch.mode_watch}")
            self._stop.check()

    def _seconds(self, cycles: int) -> float:
        return cycles * self._timing.period / NS_PER_S

    # ---- the way out ----------------------------------------------------------------------------------

    def _leave(self) -> list[str]:
        """Finish on every way out: rest, restore everything. Return failures in words."""
        self._progress("putting back", 0.0)
        network, failures = self._network, []

        def note(drive: ServoDrive, release: Release) -> None:
            if release.unwatched:
                self._say(f"{drive.name}: {release.unwatched}")
            if not release.at_rest:
                failures.append(f"{drive.name} is not confirmed at rest: {release.evidence}")

        drives = [subject.drive for subject in self._subjects if subject.configured]
        self._session.let_go(drives, note, stopped=drives if self._request.enable else ())
        network.putting_back = True
        for node, journal in network.journals.items():
            try:
                result = restore(network, journal.contents)
            except PeerFault as error:
                result = None
                failures.append(str(error))
            if result is not None and result.complete:
                journal.note_restored()
            else:
                failures += [*(result.failures if result else []), restore_command(journal.path)]
            network.watch(node, Duration(0))
            journal.close()
        network.fall_silent()
        self._disturbances = self._session.end()
        for text in failures:
            self._say(text)
        if not failures:
            self._forget_journals()
        self._world.faults.finish()
        return failures

    def _forget_journals(self) -> None:
        for journal in self._network.journals.values():
            journal.path.unlink()
        with suppress(OSError):  # somebody else's files are in it, or it was never made
            self._folder.rmdir()

    # ---- what came of it ------------------------------------------------------------------------------

    def _evaluated(self, outcome: LoopOutcome, syncs: SyncLog) -> Measured:
        echoes = syncs.echoes
        drives, all_rows, all_ways = [], [], []
        for subject, axis in zip(self._subjects, self._axes, strict=True):
            changes = acting(subject.probe.sent, subject.probe.changes)
            rows = stages.refined(subject.rows, changes, subject.probe.sent)
            ways = stages.ways(rows, echoes, acting=self._request.enable and subject.tells_demand)
            drives.append(self._drive_figures(subject, axis, rows, ways, changes, echoes))
            all_rows.append(rows)
            all_ways.append(ways)
        network = network_of(self._request.period_us, all_rows, all_ways)
        return Measured(
            request=self._request,
            cycles=outcome.cycles,
            missed=outcome.cycles_missed,
            interrupted=outcome.interrupted,
            echoes=echoes,
            host=stages.host_stages(all_rows[0], echoes),
            drives=drives,
            network=network and network.model_copy(update={"clocks": clocks_by_node(drives)}),
            timing=timing_report(self._axes, {self._request.bus: syncs}, self._session.guard.counts),
            surplus=syncs.surplus,
            distrust=distrust(self._axes, self._timing.period),
            disturbances=self._disturbances,
        )

    def _drive_figures(
        self,
        subject: Subject,
        axis: Axis,
        rows: Rows,
        ways: dict[str, Outcomes],
        changes: dict[int, TimedDemandChange],
        echoes: EchoBasis,
    ) -> MeasuredDrive:
        probe, plan = subject.probe, subject.drive.plan
        assert plan is not None
        speed, command = plan.tpdo_with(Object.VELOCITY_ACTUAL_VALUE), plan.rpdo_with(Object.TARGET_TORQUE)
        assert speed is not None
        assert command is not None
        why_not = stages.NO_DEMAND if self._request.enable else stages.NOT_ENABLED
        return MeasuredDrive(
            node=subject.drive.node_id,
            identity=subject.identity,
            speed=speed,
            command=command,
            stages=[
                *stages.reading_stages(rows, probe.to_user_code_ns),
                *stages.command_stages(rows, probe.sent, changes, probe.computation_ns, echoes, why_not),
            ],
            losses={way: losses_of(outcomes) for way, outcomes in ways.items()},
            uncertain=axis.uncertain,
            readbacks_unordered=axis.readbacks.unordered,
            clock=ClockFigures.of(axis),
            stamp=subject.stamp,
            notes=subject.notes,
        )
