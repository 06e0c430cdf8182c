"""How a bench file wants its drives, and what their data sheets say of them."""

import math
from pathlib import Path

from drivers.cia402.bench_modes import BENCH_MODES
from drivers.cia402.drive_setup import DriveSettings, Identity
from drivers.cia402.profile import QuickStopOption
from drivers.cia402.scaling import ScaleOverride
from drivers.sheets.capability import capability_of
from drivers.sheets.dictionary import LoadedDictionary, load_dictionary
from drivers.sheets.identity import told_identity
from drivers.timebase import NS_PER_MS
from hil.configuration.config import BenchConfig, Host
from hil.loop.loop import Actuation, LoopTiming


def data_sheets(config: BenchConfig) -> dict[str, LoadedDictionary]:
    """The dictionaries of the axes that name one, by axis. Raises BadInput for a file that cannot be read."""
    return {
        name: load_dictionary(Path(drive.eds), drive.node)
        for name, drive in config.drive.items()
        if drive.eds is not None
    }


def drive_settings(
    config: BenchConfig, axis: str, timing: LoopTiming, sheet: LoadedDictionary | None
) -> DriveSettings:
    """What the drive of an axis is told before it is enabled."""
    wanted, host = config.drive[axis], config.host
    limits, commissioned = wanted.limits, wanted.commissioned
    return DriveSettings(
        sync_period_ns=timing.period,
        mode=BENCH_MODES[wanted.mode],
        coherent=config.coherent(axis),
        synchronous_command=timing.actuation is Actuation.ON_SYNC,
        position_every_cycles=config.loop.position_every_cycles,
        demand_changes=config.loop.command_readback == "event",
        observed=wanted.observed,
        command_timeout_ms=_command_timeout_ms(limits.dropouts_consecutive_max, host, timing),
        drive_heartbeat_ms=wanted.heartbeat_ms,
        drive_heartbeat_timeout_ms=wanted.heartbeat_timeout_ms,
        host_heartbeat_ms=host.heartbeat_ms,
        host_heartbeat_timeout_ms=host.heartbeat_timeout_ms,
        torque_max_nm=limits.torque_max_nm,
        speed_max_rad_s=limits.speed_max_rad_s,
        quick_stop_deceleration_rad_s2=limits.quick_stop_deceleration_rad_s2,
        quick_stop_option=QuickStopOption(2 if commissioned is None else commissioned.stop.option),
        capability=None if sheet is None else capability_of(sheet),
        unwatched=wanted.unwatched,
        scale=ScaleOverride() if commissioned is None else commissioned.override,
    )


def _command_timeout_ms(dropouts_max: int, host: Host, timing: LoopTiming) -> int:
    """As many commands may fail to come as readings: not for longer than the host's heartbeat, nor for less
    than from one heartbeat to the next, so that a host that is late is not taken for one that is lost.
    """
    blind_ms = math.ceil(dropouts_max * timing.period / NS_PER_MS)
    return min(host.heartbeat_timeout_ms, max(host.heartbeat_ms, blind_ms))


def identity_notes(identity: Identity, sheet: LoadedDictionary) -> list[str]:
    """Where the drive that answers is another one than the sheet is for; what is not told does not differ."""
    told = told_identity(sheet.dictionary)
    return [
        f"the data sheet is for {name} {of_sheet:08X}h, the drive is {of_drive:08X}h"
        for name, of_sheet, of_drive in told.strangers(identity.vendor, identity.product, identity.revision)
    ]
