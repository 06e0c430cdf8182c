"""The drives of a run: their set-up from bench, data sheets and commissioning, waiting for them, and stopping
them."""

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.canopen.sdo import object_name
from servobench.drivers.cia402.drive_setup import DriveSettings, Identity
from servobench.drivers.cia402.judgement import refusal
from servobench.drivers.cia402.profile import BENCH_MODES, QuickStopOption
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, NoAnswer, PeerFault
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import LoadedDictionary, load_dictionary, told_identity
from servobench.drivers.sheets.fitness import told_by_sheet
from servobench.drivers.timebase import NS_PER_MS, duration_s
from servobench.hil.configuration.config import BenchConfig, Host
from servobench.hil.configuration.drive_file import DriveFile
from servobench.hil.loop.loop import Actuation, LoopTiming
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
