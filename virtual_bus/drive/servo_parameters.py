"""How a simulated drive is built and set, beside the motor on its shaft."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.cob_ids import NO_RTR
from servobench.drivers.canopen.objects301 import Cia301, mapping_word
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import AbortConnectionOption
from servobench.drivers.timebase import NS_PER_US
from servobench.drivers.vendors.families import Quirk
from servobench.virtual_bus.device.device_options import (
    AT_ONCE,
    DeviceIdentity,
    DeviceOptions,
    PdoDefault,
    StampLatch,
    StampOptions,
    SyncOptions,
    TaskOptions,
    unmapped_rpdos,
    unmapped_tpdos,
)
from servobench.virtual_bus.drive.firmware import FirmwareParameters
from servobench.virtual_bus.drive.load_object import SIMULATED_DRIVE, LoadTable
from servobench.virtual_bus.drive.mechanism import speed_without_load_rad_s

SERVO_DRIVE: Final = 0x0002_0192
"""Device type 1000h: device profile 402, servo drive (CiA 402-1)."""
_CLOCK_RANGE_US: Final = 1 << 32
"""Range of 1013h, an UNSIGNED32."""

SENSOR_NOISE: Final = 1
"""Its stream; that of the clock's offset has no number."""
SWITCH_BOUNCES: Final = 2


@dataclass(frozen=True, slots=True)
class DriveParameters(FirmwareParameters):
    """A simulated drive; what its master can change are defaults here."""

    quick_stop_deceleration_rad_s2: float | None = None
    """6085h; None: what half of the rated torque gives the bare motor."""
    profile_deceleration_rad_s2: float | None = None
    """6084h, the slow down ramp; None: half of the quick stop's."""
    speed_max_rad_s: float | None = None
    """6080h and its upper limit; None: the speed at which the back-EMF takes all the voltage."""
    abort_connection: AbortConnectionOption = AbortConnectionOption.QUICK_STOP
    """6007h."""
    heartbeat_ms: int = 0
    """1017h; 0: no heartbeat until the master asks for it."""
    boot_after_reset_ms: int = 40
    """From an NMT reset until the boot-up message: firmware takes tens of ms to set itself up anew. From
    power-on none; what a drive takes then is told by ``[[slow_drive]]``."""
    clock_offset_us: int | None = None
    """Reading of 1013h at power-on; None: drawn from the seed, anywhere in its range."""
    clock_drift_ppm: float = 0.0
    """How much faster than the bench the drive's clock runs."""
    stamp_unit_us: float = 1.0
    """One count of 1013h, of that clock; CiA 301 has it at 1 us."""
    stamp_resolution_us: float = 1.0
    """By how much 1013h advances at a time."""
    stamp_bits: int = 32
    """1013h counts modulo 2^stamp_bits."""
    stamp_latched: StampLatch = "sampling"
    """At which instant 1013h is latched, see
    :data:`servobench.virtual_bus.device.device_options.StampLatch`."""
    stamp_late_us: float = 0.0
    """So much later than that."""
    stamp_runs: bool = True
    """False: 1013h holds what a master wrote into it last."""
    sync_jitter_us: float = 0.0
    """The drive acts on a SYNC, and samples, up to so much after its end; drawn evenly for each."""
    sync_phase_us: float | None = None
    """It acts so long behind the SYNC as a phase-locked loop filters it; None: it has no such loop."""
    tasks: TaskOptions = AT_ONCE
    """Its tasks for PDOs; by default it acts on each when its frame ends."""
    lacks: tuple[str, ...] = ()
    """Features that it lacks; see :mod:`servobench.virtual_bus.drive.lacks`."""
    makers_units: tuple[tuple[str, Quirk], ...] = ()
    """Meanings of its maker's objects beside CiA 402-2, by
    :func:`servobench.drivers.vendors.families.quirks_for`."""
    gain_objects: bool = False
    """It has the gains of its loops as objects; see :mod:`servobench.virtual_bus.drive.loop_gains`."""
    load: LoadTable | None = None
    """Load over time available by 2100h:3; None: none."""

    def quick_stop_rad_s2(self, motor: PmsmParameters) -> float:
        """The quick stop's default deceleration for ``motor``."""
        if self.quick_stop_deceleration_rad_s2 is not None:
            return self.quick_stop_deceleration_rad_s2
        return 0.5 * motor.rated_torque_nm / motor.inertia_kg_m2

    def slow_down_rad_s2(self, motor: PmsmParameters) -> float:
        """The slow down ramp's default deceleration for ``motor``."""
        if self.profile_deceleration_rad_s2 is not None:
            return self.profile_deceleration_rad_s2
        return 0.5 * self.quick_stop_rad_s2(motor)

    def speed_limit_rad_s(self, motor: PmsmParameters) -> float:
        """The largest speed that the drive can be set to."""
        if self.speed_max_rad_s is not None:
            return self.speed_max_rad_s
        return speed_without_load_rad_s(motor, self.field)


def _ns(value_us: float) -> int:
    return round(value_us * NS_PER_US)


def seed_of(node_id: int, seed: int, stream: int) -> int:
    """Return the seed of what is random in the core of a drive."""
    return int(np.random.Generator(np.random.PCG64([seed, node_id, stream])).integers(1 << 62))


def device_options(node_id: int, drive: DriveParameters, seed: int) -> DeviceOptions:
    """Return the communication options of a drive. The clock's offset has its own stream by node."""
    offset_us = drive.clock_offset_us
    if offset_us is None:
        offset_us = int(np.random.Generator(np.random.PCG64([seed, node_id])).integers(_CLOCK_RANGE_US))
    return DeviceOptions(
        identity=DeviceIdentity(
            device_type=SERVO_DRIVE,
            vendor_id=SIMULATED_DRIVE.vendor,
            product_code=SIMULATED_DRIVE.code,
            revision_number=0x0001_0000,
            serial_number=node_id,
            device_name=SIMULATED_DRIVE.device_name,
        ),
        rpdos=(RPDO1, *unmapped_rpdos()[1:]),
        tpdos=(TPDO1, TPDO2, *unmapped_tpdos()[2:]),
        heartbeat_ms=drive.heartbeat_ms,
        boot_after_reset_ms=drive.boot_after_reset_ms,
        clock_offset_ns=offset_us * 1000,
        clock_drift_ppb=round(drive.clock_drift_ppm * 1000),
        stamp=StampOptions(
            _ns(drive.stamp_unit_us),
            _ns(drive.stamp_resolution_us),
            drive.stamp_bits,
            drive.stamp_latched,
            _ns(drive.stamp_late_us),
            drive.stamp_runs,
        ),
        sync=SyncOptions(
            _ns(drive.sync_jitter_us),
            None if drive.sync_phase_us is None else _ns(drive.sync_phase_us),
            seed,
        ),
        tasks=drive.tasks,
    )


TPDO1: Final = PdoDefault(
    NO_RTR | 0x180,
    1,
    (
        mapping_word(Object.STATUSWORD, 0, 16),
        mapping_word(Object.VELOCITY_ACTUAL_VALUE, 0, 32),
        mapping_word(Object.TORQUE_ACTUAL_VALUE, 0, 16),
    ),
)
TPDO2: Final = PdoDefault(
    NO_RTR | 0x280,
    1,
    (
        mapping_word(Object.POSITION_ACTUAL_VALUE, 0, 32),
        mapping_word(Cia301.HIGH_RESOLUTION_TIME_STAMP, 0, 32),
    ),
)
RPDO1: Final = PdoDefault(
    0x200, 255, (mapping_word(Object.CONTROLWORD, 0, 16), mapping_word(Object.TARGET_TORQUE, 0, 16))
)
