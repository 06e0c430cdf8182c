"""What may befall a node itself: silence, bus-off, faults of the drive, a clock that errs, slowness.

And what may befall the host: lateness. The ones act where the drive is simulated, the other in simulated
time. Times count from the plan's time zero, except those of a slow drive, which is slow from power-on.
"""

from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

from drivers.canopen.error_codes import ErrorRegister
from drivers.errors import MISSING
from drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration
from virtual_bus.faults.plan_checks import DELAY_MAX, require, require_nodes, require_window

CLOCK_STEP_MAX = Duration(3600 * NS_PER_S)
CLOCK_DRIFT_PPB_MAX = 10_000_000
BOOT_MAX = Duration(600 * NS_PER_S)
EVERY_MIN = Duration(100 * NS_PER_US)
"""No cycle is shorter; after a pause each strike that was missed is looked at."""
AT_ONCE = Duration(0)


class DriveFailure(Enum):
    """A fault of the drive: error code 603Fh (CiA 402-2, 6.2.3, and CiA 301, table 26) and bits of 1001h."""

    OVER_CURRENT = (0x2310, ErrorRegister.CURRENT)
    OVER_TEMPERATURE = (0x4310, ErrorRegister.TEMPERATURE)
    FOLLOWING_ERROR = (0x8611, ErrorRegister.DEVICE_PROFILE)
    ENCODER_LOSS = (0x7305, ErrorRegister.DEVICE_PROFILE)
    UNDER_VOLTAGE = (0x3220, ErrorRegister.VOLTAGE)

    @property
    def label(self) -> str:
        """As written in a plan: ``over_current``."""
        return self.name.lower()

    @property
    def code(self) -> int:
        """Error code 603Fh."""
        return self.value[0]

    @property
    def register(self) -> ErrorRegister:
        """Bits of 1001h."""
        return ErrorRegister(self.value[1] | ErrorRegister.GENERIC)


@dataclass(frozen=True, slots=True, kw_only=True)
class Occasion:
    """When something strikes: once at ``at_ns``, or again and again within a window, regularly or by chance.

    By chance: no memory, so the gaps are exponential; ``probability_per_s`` is the chance that it strikes
    at least once within a second.
    """

    at_ns: Duration | None = None
    every_ns: Duration | None = None
    """The first time so long after ``from_ns``."""
    probability_per_s: float = 0.0
    from_ns: Duration = AT_ONCE
    until_ns: Duration | None = None
    """Exclusive; None: to the end."""

    def __post_init__(self) -> None:
        other = "at_s" if self.at_ns is not None else "every_s" if self.every_ns is not None else ""
        if other:
            chance = self.probability_per_s
            require(chance == 0.0, "probability_per_s", chance, f"no {other} beside")
        if self.at_ns is not None:
            require(self.at_ns >= 0, "at_s", self.at_ns / NS_PER_S, "a time >= 0")
            require(self.every_ns is None, "every_s", (self.every_ns or 0) / NS_PER_S, "no at_s beside")
            plain = self.from_ns == 0 and self.until_ns is None
            require(plain, "from_s", self.from_ns / NS_PER_S, "no window beside at_s")
            return
        require_window(self.from_ns, self.until_ns)
        if self.every_ns is not None:
            least = f"a time from {EVERY_MIN / NS_PER_S:g} s"
            require(self.every_ns >= EVERY_MIN, "every_s", self.every_ns / NS_PER_S, least)
            return
        expected = "a probability from 0 to below 1, or at_s or every_s instead"
        value = self.probability_per_s or MISSING
        require(0.0 < self.probability_per_s < 1.0, "probability_per_s", value, expected)


@dataclass(frozen=True, slots=True, kw_only=True)
class Silence:
    """The node neither hears nor sends, as with its plug pulled; it goes on by itself."""

    kind: ClassVar[str] = "silence"
    nodes: tuple[int, ...] = ()
    """Empty: each simulated drive, each by its own chance."""
    occasion: Occasion
    lasts_ns: Duration

    def __post_init__(self) -> None:
        require_nodes(self.nodes)
        require(self.lasts_ns > 0, "duration_s", self.lasts_ns / NS_PER_S, "a time > 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOff:
    """The node's CAN controller goes bus-off; 1029h and 6007h of the node act.

    After ``recover_after_ns`` its controller begins to recover, which takes 128 times 11 recessive bits
    on a bus with error counters and no time elsewhere; None: never.
    """

    kind: ClassVar[str] = "bus_off"
    nodes: tuple[int, ...] = ()
    occasion: Occasion
    recover_after_ns: Duration | None = None

    def __post_init__(self) -> None:
        require_nodes(self.nodes)
        if self.recover_after_ns is not None:
            seconds = self.recover_after_ns / NS_PER_S
            require(self.recover_after_ns > 0, "recover_after_s", seconds, "a time > 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveFault:
    """The drive fails: EMCY, 603Fh, fault reaction of 605Eh.

    A lost encoder stands still at its last count for ``lasts_ns``; noticed after ``detected_after_ns``.
    """

    kind: ClassVar[str] = "drive_fault"
    nodes: tuple[int, ...] = ()
    occasion: Occasion
    failure: DriveFailure
    detected_after_ns: Duration = AT_ONCE
    lasts_ns: Duration = AT_ONCE

    def __post_init__(self) -> None:
        require_nodes(self.nodes)
        lost = self.failure is DriveFailure.ENCODER_LOSS
        only = 'nothing unless fault = "encoder_loss"'
        after_ms = self.detected_after_ns / NS_PER_MS
        require(lost or self.detected_after_ns == 0, "detected_after_ms", after_ms, only)
        require(lost or self.lasts_ns == 0, "duration_s", self.lasts_ns / NS_PER_S, only)
        require(0 <= self.detected_after_ns <= DELAY_MAX, "detected_after_ms", after_ms, "0 to 10000 ms")
        expected = f"at least detected_after_ms = {after_ms:g}"
        require(self.lasts_ns >= self.detected_after_ns, "duration_s", self.lasts_ns / NS_PER_S, expected)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockStep:
    """The drive's clock jumps by an amount drawn evenly from ``min_ns``..``max_ns``; negative: back."""

    kind: ClassVar[str] = "clock_step"
    nodes: tuple[int, ...] = ()
    occasion: Occasion
    min_ns: Duration
    max_ns: Duration

    def __post_init__(self) -> None:
        require_nodes(self.nodes)
        key = "step_us" if self.min_ns == self.max_ns else "step_min_us"
        far = CLOCK_STEP_MAX // NS_PER_US
        require(abs(self.min_ns) <= CLOCK_STEP_MAX, key, self.min_ns / NS_PER_US, f"from -{far} to {far} us")
        least = f"from step_min_us = {self.min_ns / NS_PER_US:g} to {far} us"
        within = self.min_ns <= self.max_ns <= CLOCK_STEP_MAX
        require(within, "step_max_us", self.max_ns / NS_PER_US, least)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockDrift:
    """The drive's clock runs faster by ``drift_ppb`` within a window, on top of its own drift."""

    kind: ClassVar[str] = "clock_drift"
    nodes: tuple[int, ...] = ()
    from_ns: Duration = AT_ONCE
    until_ns: Duration | None = None
    drift_ppb: int

    def __post_init__(self) -> None:
        require_nodes(self.nodes)
        require_window(self.from_ns, self.until_ns)
        most = CLOCK_DRIFT_PPB_MAX / 1000
        within = abs(self.drift_ppb) <= CLOCK_DRIFT_PPB_MAX
        require(within, "drift_ppm", self.drift_ppb / 1000, f"from {-most:g} to {most:g}")


@dataclass(frozen=True, slots=True)
class Range:
    """A time drawn evenly from ``min_ns``..``max_ns``, both included."""

    min_ns: Duration = AT_ONCE
    max_ns: Duration = AT_ONCE


@dataclass(frozen=True, slots=True, kw_only=True)
class SlowDrive:
    """A drive that takes its time from power-on: for SDO answers, for its PDOs, to boot after any reset.

    Frames of each of the two classes keep their order. While it boots, it hears and sends nothing.
    """

    kind: ClassVar[str] = "slow_drive"
    nodes: tuple[int, ...] = ()
    sdo: Range = Range()
    tpdo: Range = Range()
    boot: Range = Range()

    def __post_init__(self) -> None:
        require_nodes(self.nodes)
        parts = (("sdo", self.sdo, DELAY_MAX), ("tpdo", self.tpdo, DELAY_MAX), ("boot", self.boot, BOOT_MAX))
        for name, part, most in parts:
            unit, scale = ("_s", NS_PER_S) if name == "boot" else ("_us", NS_PER_US)
            stem = name if name == "boot" else f"{name}_delay"
            fixed = part.min_ns == part.max_ns
            least, limit = part.min_ns / scale, most / scale
            key = f"{stem}{unit}" if fixed else f"{stem}_min{unit}"
            require(0 <= part.min_ns <= most, key, least, f"a time from 0 to {limit:g}")
            within = part.min_ns <= part.max_ns <= most
            expected = f"a time from {stem}_min{unit} = {least:g} to {limit:g}"
            require(within, f"{stem}_max{unit}", part.max_ns / scale, expected)
        some = any(part.max_ns > 0 for _, part, _ in parts)
        require(
            some, "sdo_delay_us", MISSING, "sdo_delay_us, tpdo_delay_us or boot_s, or a _min and _max of it"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class HostStall:
    """The host's next action is late, by a time drawn evenly from ``min_ns``..``max_ns``, both included.

    It strikes the first action at or after its instant. Of several strikes of one table since the last action
    the longest counts; those of several tables add up.
    """

    kind: ClassVar[str] = "host_stall"
    occasion: Occasion
    min_ns: Duration
    max_ns: Duration

    def __post_init__(self) -> None:
        key = "late_us" if self.min_ns == self.max_ns else "late_min_us"
        most = DELAY_MAX // NS_PER_US
        require(0 <= self.min_ns <= DELAY_MAX, key, self.min_ns / NS_PER_US, f"a time from 0 to {most} us")
        least = f"a time from late_min_us = {self.min_ns / NS_PER_US:g} to {most} us"
        require(self.min_ns <= self.max_ns <= DELAY_MAX, "late_max_us", self.max_ns / NS_PER_US, least)


NodeFault = Silence | BusOff | DriveFault | ClockStep | ClockDrift | SlowDrive
EventFault = Silence | BusOff | DriveFault | ClockStep
