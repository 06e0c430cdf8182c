"""The drives of a run in the hands of a host: set up, waited for, guarded, cycled in a loop, and let go at
rest or with a reason.

A run, a measurement and a commissioning go through it:

    configure -> cycle (the guard is armed) -> calibrate, enable, loop -> let_go (at rest, disabled) -> end

What lies between differs: which objects are written and read back, what a controller does, who is told.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.cia402.drive_setup import DriveSettings, Identity
from servobench.drivers.cia402.judgement import refusal
from servobench.drivers.cia402.profile import BENCH_MODES, QuickStopOption
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BadInput, NoAnswer, PeerFault
from servobench.drivers.exchange import Master
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import LoadedDictionary, load_dictionary, told_identity
from servobench.drivers.sheets.fitness import told_by_sheet
from servobench.drivers.timebase import NS_PER_MS, Instant, duration_s
from servobench.hil.configuration.config import BenchConfig, Foreign, Guard, Host
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.drive_file import DriveFile
from servobench.hil.execution.bus_guard import NO_BENCH, BusGuard
from servobench.hil.execution.world import World
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.loop import Actuation, Loop, LoopTiming
from servobench.hil.loop.pace import Pace
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.machine.stopping import StopRequest

_SLICE_S = 0.3
"""Longest delay until a stop signal is noticed."""


def data_sheets(config: BenchConfig) -> dict[str, LoadedDictionary]:
    """Load the dictionaries of the axes that name one, by axis. Raises BadInput for an unreadable file, and
    for a drive that cannot be commanded in the mode of its axis."""
    sheets = {}
    for name, drive in config.drive.items():
        if drive.eds is None:
            continue
        sheets[name] = sheet = load_dictionary(Path(drive.eds), drive.node)
        if why := refusal(told_by_sheet(sheet), drive.node, BENCH_MODES[drive.mode]):
            expected = f"a mode that the drive of {drive.eds} can be commanded in"
            raise BadInput(config.source, f"drive.{name}.mode", drive.mode, expected, why)
    return sheets


def drive_settings(
    config: BenchConfig, axis: str, timing: LoopTiming, sheet: LoadedDictionary | None
) -> DriveSettings:
    """Return the settings of an axis' drive before it is enabled."""
    drive, host = config.drive[axis], config.host
    limits, commissioned = drive.limits, drive.commissioned
    return DriveSettings(
        sync_period_ns=timing.period,
        mode=BENCH_MODES[drive.mode],
        coherent=config.coherent(axis),
        counted=config.counted(axis),
        synchronous_command=timing.actuation is Actuation.ON_SYNC,
        position_every_cycles=config.loop.position_every_cycles,
        demand_changes=config.loop.command_readback == "event",
        observed=drive.observed,
        command_timeout_ms=_command_timeout_ms(limits.dropouts_consecutive_max, host, timing),
        drive_heartbeat_ms=drive.heartbeat_ms,
        drive_heartbeat_timeout_ms=drive.heartbeat_timeout_ms,
        host_heartbeat_ms=host.heartbeat_ms,
        host_heartbeat_timeout_ms=host.heartbeat_timeout_ms,
        torque_max_nm=limits.torque_max_nm,
        speed_max_rad_s=limits.speed_max_rad_s,
        set_acceleration_rad_s2=limits.set_acceleration_max_rad_s2,
        quick_stop_deceleration_rad_s2=limits.quick_stop_deceleration_rad_s2,
        quick_stop_option=QuickStopOption(2 if commissioned is None else commissioned.stop.option),
        capability=None if sheet is None else capability_of(sheet),
        bears_lapses=config.guard.on_mode == "tell",
        unwatched=drive.unwatched,
        scale=ScaleOverride() if commissioned is None else commissioned.override,
    )


def _command_timeout_ms(dropouts_max: int, host: Host, timing: LoopTiming) -> int:
    """Return the command time-out: that of readings, at most the host's heartbeat time-out, and at least one
    heartbeat period, so that a late host does not count as lost."""
    blind_ms = math.ceil(dropouts_max * timing.period / NS_PER_MS)
    return min(host.heartbeat_timeout_ms, max(host.heartbeat_ms, blind_ms))


def identity_notes(identity: Identity, sheet: LoadedDictionary) -> list[str]:
    """Say where the answering drive differs from its sheet; an unknown value does not differ."""
    told = told_identity(sheet.dictionary)
    return [
        f"the data sheet is for {name} {of_sheet:08X}h, the drive is {of_drive:08X}h"
        for name, of_sheet, of_drive in told.strangers(identity.vendor, identity.product, identity.revision)
    ]


def connect(drive: ServoDrive, timeout_s: float, stop: StopRequest) -> Identity:
    """Wait for the drive and return its identity. Raises NoAnswer after ``timeout_s``, Interrupted on a stop
    signal."""
    network = drive.network
    deadline = network.deadline_after(duration_s(timeout_s))
    while True:
        stop.check()
        slice_end = min(deadline, network.deadline_after(duration_s(_SLICE_S)))
        try:
            return drive.connect(slice_end)
        except NoAnswer:
            if network.clock.now() >= deadline:
                raise
            network.pump(slice_end)  # a transfer that fails at once is not to flood the bus with the next


_REMEDY: Final = "commission this drive, or take its 'commissioned' out of the bench file"
_SIMULATED_REMEDY: Final = (
    "the bench simulates its drive itself: name the data sheet of the commissioned one "
    "(drive.NAME.simulation.eds), or run on the bus of the commissioned one (--bus)"
)


def write_commissioned(drive: ServoDrive, file: DriveFile, *, simulated: bool = False) -> None:
    """Compare the drive with its file and write the file's objects; the drive is connected and disabled.
    ``simulated``: the bench makes it itself.

    Raises PeerFault if it is another drive, SettingRefused or TransferAborted if it does not take a setting.
    """
    identity, marks = drive.identity, file.drive
    assert identity is not None, "connect comes first"
    for what, held, wanted in (
        ("vendor", identity.vendor, marks.vendor),
        ("product", identity.product, marks.product),
        ("serial number", identity.serial, marks.serial),
    ):
        if wanted and held != wanted:
            raise PeerFault(
                f"{drive.name} is not the drive that was commissioned",
                f"{what} {held}, its drive file says {wanted}",
                (_SIMULATED_REMEDY if simulated else _REMEDY).replace("NAME", drive.name),
            )
    network, node = drive.network, drive.node_id
    for setting in file.object:
        data = bytes.fromhex(setting.bytes)
        network.download(node, setting.index, setting.sub, data)
        held_bytes = network.upload(node, setting.index, setting.sub)
        if held_bytes != data:
            raise SettingRefused(
                f"{drive.name} holds {held_bytes.hex()} in {object_name(setting.index, setting.sub)}",
                f"{setting.bytes} was written to it",
            )


def stop_all(drives: Sequence[ServoDrive]) -> None:
    """Send a quick stop to each by RPDO, then by SDO; release repeats and reports failures.

    A silent drive delays the next one; a drive whose commands cease while another is brought to rest would
    report a fault.
    """
    for asking in (False, True):
        stop_each(drives, asking=asking)


def stop_each(drives: Sequence[ServoDrive], *, asking: bool = False) -> None:
    """Send a quick stop to each by RPDO and, if ``asking``, by SDO; failures are left to :func:`stop_all`."""
    for drive in drives:
        with suppress(PeerFault):
            drive.stop(asking=asking)


ENABLE_LIMIT_S: Final = 2.0
"""A drive that charges its DC link or releases a brake takes a second or so."""


def _nothing() -> None:
    """Do nothing."""


class DriveSession:
    """Drives, and the guard of their bus."""

    def __init__(
        self,
        world: World,
        networks: Mapping[str | None, CanopenNetwork],
        drives: Sequence[ServoDrive],
        rules: Guard,
        tell: Callable[[Instant, str, str], None],
        *,
        own_sync: bool = True,
        repeated: Collection[Foreign] = (),
    ) -> None:
        """See :class:`BusGuard`."""
        self.guard = BusGuard(
            networks, drives, rules, tell, world.error_frames, own_sync=own_sync, repeated=repeated
        )
        self._world = world

    def enable(self, drive: ServoDrive, limit_s: float = ENABLE_LIMIT_S) -> None:
        """Enable a configured drive. Raises PeerFault."""
        drive.enable(drive.network.deadline_after(duration_s(limit_s)))

    def cycle(
        self,
        master: Master,
        axes: Sequence[Axis],
        pace: Pace,
        timing: LoopTiming,
        syncs: Mapping[str | None, SyncLog],
        *,
        delays_of: Sequence[Axis] = (),
        bench: Mapping[str, DriveConfig] = NO_BENCH,
        chore: Callable[[Instant], None] | None = None,
    ) -> Loop:
        """Arm the guard, and return the loop that it attends.

        ``delays_of``, ``bench``: see :meth:`BusGuard.arm`; ``chore``: another for each cycle.
        """
        self.guard.arm(syncs, timing.period, delays_of, bench)
        return Loop(master, self._world.clock, axes, pace, timing, self.guard.attending(chore))

    def let_go(
        self,
        drives: Sequence[ServoDrive],
        released: Callable[[ServoDrive, Release], None],
        *,
        stopped: Sequence[ServoDrive] | None = None,
        unload: Callable[[], None] = _nothing,
    ) -> None:
        """Bring the drives to rest, disable them and let them go: every way out leads through here.

        Injected faults end, and the guard ends nothing any more. All drives are told to stop before the first
        is let go; then ``unload`` takes their loads away. ``stopped``: those to stop, by default all; one
        that was never enabled has nothing to stop. Whatever ``unload`` and ``released`` raise, each drive
        is let go, and the last of their errors is passed on.
        """
        self.guard.calm()
        self._world.faults.stop()
        with ExitStack() as every:
            for drive in reversed(drives):
                every.callback(lambda each: released(each, each.release()), drive)
            stop_all(drives if stopped is None else stopped)
            unload()

    def end(self, zero: Instant | None = None) -> tuple[str, ...]:
        """Return the frames of others, as far as they disturbed; see :meth:`BusGuard.end`."""
        return self.guard.end(self._world.clock.now(), zero)
