"""One simulated drive with a master beside it, on the bus of a test."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from servobench.drivers.canopen.error_codes import error_text
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import MANUFACTURER, object_name
from servobench.drivers.canopen.write_list import ListedWrite, WriteList
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, duration_s
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.bench_file import PathLike
from servobench.hil.execution.device_files import DeviceFiles
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.testing.hosted import DriveHost, DriveProcess, DriveWish
from servobench.hil.testing.wire import Wire, intended_frames
from servobench.hil.verdict.arguments import check_arguments, checked
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters

__tracebackhide__ = True
"""Hides this file from pytest's tracebacks: a failed assertion is shown where the test makes it."""
ENABLE_LIMIT_S = 5.0
_PERIOD_NS = NS_PER_MS
_PERIOD_LIVE_NS = 10 * NS_PER_MS
"""A test process is no controller: on a bus in real time its cycle is slow."""
_POLL_NS = 5 * NS_PER_MS


class DriveRig:
    """A drive, its master, and the wire between them.

    rig.enable()
    rig.run(0.2, torque_nm=0.5)
    rig.client.quick_stop(rig.deadline(1.0))
    rig.assert_reaches(State.SWITCH_ON_DISABLED, within_s=0.5)
    rig.assert_no_unintended_frame()
    """

    def __init__(
        self,
        world: World,
        wish: DriveWish,
        device: SimulatedServo | None = None,
        process: DriveProcess | None = None,
    ) -> None:
        self.node = wish.node
        self.motor = wish.motor_file
        self.device = device
        """The simulated drive itself; None on a bus in real time, where it is :attr:`process`."""
        self.process = process
        self.clock = world.clock
        self.wire = Wire(self.clock.now())
        """Every frame seen by the master's adapter; times count from the making of the rig."""
        world.link.tap(self.wire.take)
        self.network = CanopenNetwork(world.link, world.clock, writes=RIG)
        self.client = ServoDrive(self.network, wish.node)
        """The drive as the bench sees it: states, modes, moves, objects."""
        self._live = world.real_time

    @property
    def period(self) -> Duration:
        """Period of :meth:`run`, ns: 1 ms, on a bus in real time 10 ms."""
        return Duration(_PERIOD_LIVE_NS if self._live else _PERIOD_NS)

    @property
    def settings(self) -> DriveSettings:
        """Settings written by :meth:`configure`: rated torque and speed as limits, and patient heartbeats."""
        motor = self.motor.parameters
        return DriveSettings(
            self.period,
            host_heartbeat_ms=100,
            host_heartbeat_timeout_ms=1000,
            drive_heartbeat_ms=100,
            drive_heartbeat_timeout_ms=1000,
            torque_max_nm=motor.rated_torque_nm,
            speed_max_rad_s=motor.rated_speed_rad_s,
        )

    @checked
    def deadline(self, seconds: float) -> Instant:
        """Return the instant ``seconds`` from now, for the methods of :attr:`client`."""
        return self.network.deadline_after(duration_s(seconds))

    @checked
    def wait(self, seconds: float) -> None:
        """Let time pass; frames are taken in, and the heartbeat goes out."""
        self.network.pump(self.deadline(seconds))

    def configure(self, **changes: Any) -> list[str]:
        """Connect and set the drive up; ``changes``: fields of :class:`.drive_setup.DriveSettings`.

        Returns objects that the drive lacks or did not take, in words.
        """
        check_arguments("configure", DriveSettings, changes)
        self.client.connect(self.deadline(ENABLE_LIMIT_S))
        return self.client.configure(replace(self.settings, **changes))

    @checked
    def allow_write(self, index: int, sub: int = 0) -> None:
        """Let the test write an object that neither the set-up nor a move needs, by ``client.objects``.

        An object of 2000h to 5FFFh is its maker's, and then allowed for the drive that was connected alone.
        """
        product = self.network.writes.products.get(self.node) if index in MANUFACTURER else None
        name = object_name(index, sub)
        write = ListedWrite(range(index, index + 1), (sub,), name, "asked for", "test", product)
        self.network.writes.allowed |= WriteList("the test", (write,))

    def enable(self, **changes: Any) -> None:
        """Call :meth:`configure` if necessary, then go to OPERATION ENABLED."""
        if self.client.plan is None or changes:
            self.configure(**changes)
        self.client.enable(self.deadline(ENABLE_LIMIT_S))

    @checked
    def run(self, seconds: float, torque_nm: float | Callable[[Reading], float] = 0.0) -> list[Reading]:
        """Run cycles of SYNC, readings, and a torque set-point in response to each; return the readings.

        ``torque_nm``: one for all, or a function of the reading. Raises DriveInFault or NoAnswer if the drive
        falls out of OPERATION ENABLED or is lost.
        """
        taken: list[Reading] = []
        due = self.clock.now()
        for _ in range(round(seconds * NS_PER_S / self.period)):
            due = Instant(due + self.period)
            self.network.send_sync()
            while self.network.pump_one(due):
                for reading in self.client.take_readings():
                    torque = torque_nm(reading) if callable(torque_nm) else torque_nm
                    self.client.write(Command(self.network.sync_count, torque, due, due))
                    taken.append(reading)
            self.client.check()
        return taken

    def state(self) -> State | None:
        """Read the drive's state now by SDO."""
        return self.client.control.read_state()

    @checked
    def assert_reaches(self, state: State, *, within_s: float) -> float:
        """Assert that the drive comes into ``state``; return after how long it was seen there, s."""
        began, seen = self.clock.now(), list[str]()
        while True:
            now = self.state()
            took_s = (self.clock.now() - began) / NS_PER_S
            label = "no state of CiA 402" if now is None else now.value
            if not seen or seen[-1] != label:
                seen.append(label)
            if now is state:
                return took_s
            if took_s > within_s:
                raise AssertionError(
                    f"node {self.node}: not in '{state.value}' after {within_s:g} s; "
                    f"it was in {', then in '.join(map(repr, seen))}{self._emergencies()}"
                )
            self.network.pump(Instant(self.clock.now() + _POLL_NS))

    @checked
    def assert_stays(self, state: State, *, for_s: float) -> None:
        """Assert that the drive is in ``state`` now and does not leave it."""
        began = self.clock.now()
        while (held_s := (self.clock.now() - began) / NS_PER_S) < for_s:
            now = self.state()
            if now is not state:
                label = "no state of CiA 402" if now is None else f"'{now.value}'"
                raise AssertionError(
                    f"node {self.node}: {label} after {held_s:.3f} s, to stay in '{state.value}' for "
                    f"{for_s:g} s{self._emergencies()}"
                )
            self.network.pump(Instant(self.clock.now() + _POLL_NS))

    @checked
    def assert_no_unintended_frame(self, *, allow: tuple[str, ...] = ()) -> None:
        """Assert that only regular frames of master and drive were on the wire since :meth:`Wire.clear`.

        NMT, SYNC, heartbeats, SDO, and the PDOs of the plan in their lengths. ``allow``: patterns of
        :mod:`servobench.hil.testing.wire` for further allowed frames, e.g. ``"081#*"`` for the EMCY of node
        1.
        """
        self.wire.assert_only(intended_frames(self.network.node_id, self.node, self._plan_written()), allow)

    @checked
    def assert_controlwords(self, *words: int) -> None:
        """Assert that the host sent these controlwords and no others since :meth:`Wire.clear`.

        By every RPDO that carries one, and by SDO; a word that is repeated in a row counts once.
        """
        seen = self.wire.controlwords(self.node, self._plan_written())
        if [command.word for command in seen] != [*words]:
            expected = " ".join(f"{word:04X}h" for word in words) or "none"
            lines = [f"  {(at - self.wire.zero) / NS_PER_S:.6f} s {word:04X}h" for at, word in seen]
            raise AssertionError(
                f"node {self.node}: controlwords {expected} expected, the host sent"
                + ("\n".join([":", *lines]) if lines else " none")
            )

    def release(self) -> None:
        """Leave the drive at rest, as a run does at its end."""
        self.client.release()

    def _plan_written(self) -> Any:
        if self.client.plan is None:
            raise ValueError("the drive was not configured: no PDO is intended yet")
        return self.client.plan

    def _emergencies(self) -> str:
        codes = dict.fromkeys(each.code for each in self.network.emergencies if each.node_id == self.node)
        told = ", ".join(f"{code:04X}h {error_text(code)}" for code in list(codes)[-3:])
        return f"; EMCY: {told}" if told else ""


@contextmanager
def drive_rig(bus: str, host: DriveHost, wish: DriveWish) -> Iterator[DriveRig]:
    """Make a drive on ``bus`` with its master; afterwards the drive is at rest and the bus closed."""
    spec = parse_bus_spec(bus, "servo_bus")
    process, devices, plan = None, list[SimulatedServo](), None
    if spec.simulated:
        files = DeviceFiles(_path(wish.eds), _path(wish.store))
        motor, memory = wish.motor_file.parameters, files.memory([wish.node])
        vendor = files.vendor(lambda _repair: None, motor=motor)
        devices = [
            SimulatedServo(wish.node, motor, files.drive(DriveParameters()), wish.seed, memory, vendor)
        ]
        plan = wish.plan
    elif host.missing([wish.node]):
        process = host.start([wish.node], wish)
    world_plan = WorldPlan(spec, wish.bitrate_bit_s, faults=plan, seed=wish.seed)
    with open_world(world_plan, devices) as world:
        world.faults.start(world.clock.now())
        rig = DriveRig(world, wish, devices[0] if devices else None, process)
        try:
            yield rig
        finally:
            world.faults.stop()
            rig.release()


def _path(name: PathLike | None) -> Path | None:
    return None if name is None else Path(name)
