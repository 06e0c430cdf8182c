"""Options of a simulated CANopen device: identity, PDO defaults, communication defaults."""

from dataclasses import dataclass, field
from typing import Final, Literal

from servobench.drivers.canopen.cob_ids import NO_RTR, NOT_VALID
from servobench.drivers.timebase import NS_PER_US


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Objects 1000h, 1008h..100Ah and 1018h."""

    device_type: int = 0
    vendor_id: int = 0
    product_code: int = 0
    revision_number: int = 0
    serial_number: int = 0
    device_name: str = "simulated device"


@dataclass(frozen=True, slots=True)
class PdoDefault:
    """One PDO as the device comes up."""

    cob_id: int
    """COB-ID without the node-ID, which is added; bit 31: not valid, bit 30: no RTR (TPDO)."""
    transmission_type: int
    mapping: tuple[int, ...] = ()
    """Mapping words, index << 16 | sub-index << 8 | bits, as in 1600h and 1A00h."""
    inhibit_time_100us: int = 0
    event_timer_ms: int = 0


def unmapped_rpdos() -> tuple[PdoDefault, ...]:
    """RPDO 1..4 at the predefined COB-IDs, switched off, nothing mapped."""
    return tuple(PdoDefault(NOT_VALID | 0x200 + 0x100 * number, 255) for number in range(4))


def unmapped_tpdos() -> tuple[PdoDefault, ...]:
    """TPDO 1..4 at the predefined COB-IDs, switched off, nothing mapped."""
    return tuple(PdoDefault(NOT_VALID | NO_RTR | 0x180 + 0x100 * number, 255) for number in range(4))


StampLatch = Literal["sampling", "arrival", "tick"]
"""``sampling``: 1013h is the clock at the instant at which it is asked for, in a synchronous TPDO that of the
sampling. ``arrival``: at the end of the last SYNC frame, whenever the device samples. ``tick``: at the next
tick of the device's inner loops."""
STAMP_BITS: Final = range(16, 33)
"""How wide the counter may be: a narrower one wraps before a bench with a slow loop can count it on."""
STAMP_LATE_MAX_NS: Final = 100 * NS_PER_US
"""The most that a stamp may be latched late by: its frame takes longer than that at 1 Mbit/s, so no stamp
tells an instant that has not come yet."""


@dataclass(frozen=True, slots=True)
class StampOptions:
    """How 1013h tells of the device's clock."""

    unit_ns: int = NS_PER_US
    """Duration of one count."""
    resolution_ns: int = NS_PER_US
    """By how much the counter advances at a time."""
    bits: int = 32
    """It counts modulo 2^bits."""
    latched: StampLatch = "sampling"
    late_ns: int = 0
    """So much later than that."""
    runs: bool = True
    """False: 1013h holds what a master wrote into it last, 0 at first."""

    def __post_init__(self) -> None:
        """Error: ValueError for what no counter can be."""
        if not 0 < self.unit_ns <= self.resolution_ns:
            raise ValueError(f"stamp: resolution {self.resolution_ns} ns: at least {self.unit_ns} expected")
        if self.bits not in STAMP_BITS:
            raise ValueError(f"stamp: {self.bits} bits: {STAMP_BITS[0]}..{STAMP_BITS[-1]} expected")
        if not 0 <= self.late_ns <= STAMP_LATE_MAX_NS:
            raise ValueError(f"stamp: {self.late_ns} ns late: 0..{STAMP_LATE_MAX_NS} expected")


@dataclass(frozen=True, slots=True)
class SyncOptions:
    """When the device acts on a SYNC; at the end of its frame by default."""

    jitter_ns: int = 0
    """Up to so much later, drawn evenly for each: what its task takes to wake."""
    phase_ns: int | None = None
    """So long behind the SYNC as a phase-locked loop filters it; None: there is no such loop."""
    seed: int = 0
    """Seed of the jitter; each node has its own stream."""

    @property
    def at_once(self) -> bool:
        """True if every SYNC acts at the end of its frame."""
        return not self.jitter_ns and self.phase_ns is None


@dataclass(frozen=True, slots=True)
class TaskOptions:
    """Periodic tasks that take PDOs in and send them, their ticks counted from power-on."""

    rpdo_ns: int = 0
    """An RPDO is taken in at the next tick of so long a period; 0: when its frame ends."""
    rpdo_phase_ns: int = 0
    """The first tick, after power-on."""
    dead_ns: int = 0
    """From that tick until the RPDO acts, or waits for its SYNC."""
    tpdo_ns: int = 0
    """A SYNC is acted on, and an event-driven TPDO sampled and sent, at the next tick of this one; 0: at
    once."""
    tpdo_phase_ns: int = 0
    locked: bool = False
    """Ticks count from the last SYNC that was acted on, once there was one."""

    def __post_init__(self) -> None:
        """Error: ValueError for a phase that is none."""
        for name, phase_ns, period_ns in (
            ("rpdo", self.rpdo_phase_ns, self.rpdo_ns),
            ("tpdo", self.tpdo_phase_ns, self.tpdo_ns),
        ):
            if not 0 <= phase_ns < max(period_ns, 1):
                expected = f"0 up to its period, {period_ns} ns, expected"
                raise ValueError(f"{name} task: phase {phase_ns} ns: {expected}")


AT_ONCE: Final = TaskOptions()
"""The default of a simulated device."""


@dataclass(frozen=True, slots=True)
class DeviceOptions:
    """Everything about a device's communication that its dictionary starts with."""

    identity: DeviceIdentity = DeviceIdentity()
    rpdos: tuple[PdoDefault, ...] = field(default_factory=unmapped_rpdos)
    """RPDO 1.. in order: 1400h.. and 1600h.."""
    tpdos: tuple[PdoDefault, ...] = field(default_factory=unmapped_tpdos)
    """TPDO 1.. in order: 1800h.. and 1A00h.."""
    heartbeat_ms: int = 0
    """Default of 1017h."""
    boot_after_reset_ms: int = 0
    """From an NMT reset, or a node-ID by LSS, until the boot-up message. From power-on it is none."""
    clock_offset_ns: int = 0
    """Reading of the device's own clock at power-on."""
    clock_drift_ppb: int = 0
    """How much faster than the bench the device's clock runs, parts per 10^9."""
    stamp: StampOptions = StampOptions()
    """How 1013h tells of that clock."""
    sync: SyncOptions = SyncOptions()
    tasks: TaskOptions = AT_ONCE
