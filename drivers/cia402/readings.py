"""Turns the TPDOs of one drive into readings in SI units."""

from typing import Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import PdoMap, PdoPlan
from servobench.drivers.cia402.command_watch import CommandWatch
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Status
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.exchange import DemandChange, Readback, Reading
from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.drivers.vendors.stamps import STANDARD_STAMP, StampProfile

_WORD: Final = 1 << 32
_HALF_WORD: Final = 1 << 31
_REACH_PERIODS: Final = 64
"""A stamp further than this from the previous one means a clock that was set, or a long silence: the speed
says nothing about the way in between. A bench tolerates fewer lost readings in a row."""
NEVER_TOLD: Final = Instant(-1)
_LIMITED: Final = int(Status.INTERNAL_LIMIT_ACTIVE)
_NAN: Final = float("nan")


class LastStatusword:
    """The last statusword of a drive, by PDO or SDO."""

    __slots__ = ("at", "by_pdo", "statusword")

    def __init__(self) -> None:
        self.statusword = -1
        """0x6041, raw; -1 before the first."""
        self.at = NEVER_TOLD
        """When it arrived."""
        self.by_pdo = -1
        """The last one by PDO."""

    def take(self, statusword: int, at: Instant) -> None:
        """Take in a statusword of the drive."""
        self.statusword = statusword
        self.at = at


class ReadingAssembler:
    """Makes a reading from every frame that carries the speed; all other values are the last known.

    So no reading mixes two SYNCs: a value of another SYNC carries the instant of its own frame. The drive's
    stamp is used if it is in that very frame.

    A position is of the SYNC whose frames it travels with, and is carried on by the mean of the speeds of two
    readings, over the time between them: by the drive's stamps, without them by the SYNCs sent. Each position
    frame anchors it anew:

        SYNC          k          k+1        k+2        ...  k+n
        TPDO1         speed      speed      speed           speed
        TPDO2          position                              position
        reading       carried    + speed T  + speed T  ...  carried

    If the position's frame comes before the speed's (a lower identifier, or the same frame), a reading has
    the position of its own SYNC.
    """

    def __init__(
        self,
        network: CanopenNetwork,
        plan: PdoPlan,
        scaling: Scaling,
        period_ns: Duration,
        told: LastStatusword,
        follow: FollowWatch,
        stamp: StampProfile = STANDARD_STAMP,
    ) -> None:
        """``told`` and ``follow`` take in the reported state and mode. ``stamp``: how the drive stamps.
        Raises ValueError if the plan lacks speed, position or statusword."""
        needed = (Object.STATUSWORD, Object.POSITION_ACTUAL_VALUE, Object.VELOCITY_ACTUAL_VALUE)
        missing = [f"{index:04X}h" for index in needed if plan.tpdo_with(index) is None]
        if missing:
            raise ValueError(f"the PDO plan lacks {', '.join(missing)}")
        self.scaling = scaling
        self.stamp = stamp
        self.malformed = 0
        """PDOs whose length differs from the mapping."""
        self.readings_made = 0
        self.watch: CommandWatch | None = None
        """Called with every demand, or torque, that arrives."""
        self.torque_told_at = NEVER_TOLD
        self.position_told_at = NEVER_TOLD
        self._pump = network.frame_pump
        self._told = told
        self._follow = follow
        self._rad_s_per_raw = scaling.velocity_sign * scaling.velocity_rad_s
        self._nm_per_raw = scaling.torque_sign * scaling.torque_nm
        self._rad_per_count = scaling.position_rad
        self._period_ns = period_ns
        self._period_us = max(1, period_ns // NS_PER_US)
        self._reach_us = _REACH_PERIODS * self._period_us
        self._readings: list[Reading] = []
        self._readbacks: list[Readback] = []
        self._changes: list[DemandChange] = []
        self._torque_raw: int | None = None
        self._velocity_rad_s = 0.0
        self._position = 0
        self._position_raw: int | None = None
        self._carried_rad = 0.0
        self._carried_to_us = 0
        self._anchored_at = NEVER_TOLD
        self._last_at = NEVER_TOLD
        self._last_us = 0
        self._stamp_raw: int | None = None
        self._count = 0
        """The last stamp, unwrapped."""
        self._count_ns = stamp.unit_ns
        self._wrap, self._half_wrap = 1 << stamp.bits, 1 << (stamp.bits - 1)
        self._inlets: dict[int, _Inlet] = {}
        self._subscribe(network, plan, follow, stamp.index)

    def keep_frames(self, cob_id: int) -> None:
        """Begin to keep the frames of a TPDO, malformed ones included, for :meth:`take_frames`."""
        self._inlets[cob_id].kept = []

    def take_frames(self, cob_id: int) -> list[tuple[bytes, Instant]]:
        """Return the frames since the last call, each with its instant; none if they are not kept."""
        inlet = self._inlets[cob_id]
        kept = inlet.kept
        if not kept:
            return []
        inlet.kept = []
        return kept

    def take(self) -> list[Reading]:
        """Return the readings completed since the last call, oldest first."""
        taken, self._readings = self._readings, []
        return taken

    def take_readbacks(self) -> list[Readback]:
        """Return the torque demands received with a SYNC since the last call, oldest first."""
        taken = self._readbacks
        if taken:
            self._readbacks = []
        return taken

    def take_demand_changes(self) -> list[DemandChange]:
        """Return the torque demands received on change since the last call, oldest first."""
        taken = self._changes
        if taken:
            self._changes = []
        return taken

    @property
    def torque_nm(self) -> float:
        """Last torque received; NaN before the first."""
        raw = self._torque_raw
        return _NAN if raw is None else raw * self._nm_per_raw

    def position_rad(self, raw: int | None) -> float:
        """Convert a raw position near the last one to rad, on the scale of the readings; None: the last
        one."""
        counted = self._position
        if raw is not None and self._position_raw is not None:
            counted += ((raw - self._position_raw + _HALF_WORD) % _WORD) - _HALF_WORD
        return counted * self._rad_per_count

    # ---- what the frames tell -------------------------------------------------------------------------

    def anchor_position(self, raw: int, at: Instant) -> None:
        """Anchor the position: 0x6064 as read at ``at``, from which positions are extrapolated."""
        self._unwrap_position(raw)
        self.position_told_at = at
        self._carried_rad = 0.0
        if self._leads:
            self._anchored_at = at
        elif self._stamped:
            # Of the SYNC of the last reading; or of one whose speed was lost on the way.
            self._carried_to_us = self._last_us + self._periods(at - self._last_at) * self._period_us
        else:
            self._carried_to_us = self._pump.sync_count * self._period_us

    def torque_told(self, raw: int, at: Instant) -> None:
        """Take in 0x6077, or the current used in its place."""
        self._torque_raw = raw
        self.torque_told_at = at

    def demand_told(self, raw: int, at: Instant, in_reading: bool) -> None:
        """Take in 0x6074 of a SYNC, from the frame of the last reading or from another."""
        self._readbacks.append(Readback(raw, at, self.readings_made, in_reading))

    def demand_changed(self, raw: int, stamp_raw: int, at: Instant) -> None:
        """Take in 0x6074 sent on change; ``stamp_raw``: 0x1013 of that moment."""
        self._changes.append(DemandChange(raw, self._unwrapped(stamp_raw) * self._count_ns, at))

    def tell_watch(self, watch: CommandWatch, raw: int) -> None:
        """Pass a demand or torque to the watch. A drive that itself reports not following needs no watch."""
        if self._follow.lapse is not None:
            watch.excuse()
        else:
            watch.told(raw, self._told.statusword & _LIMITED != 0)

    def speed_told(self, raw: int, stamp_raw: int, at: Instant) -> None:
        """Take in 0x606C with its stamp 0x1013, or -1: a reading."""
        device_time_ns = None
        if stamp_raw >= 0:
            self._count = self._unwrapped(stamp_raw)
            self._stamp_raw = stamp_raw
            device_time_ns = self._count * self._count_ns
            us = device_time_ns // NS_PER_US
        else:
            us = self._pump.sync_count * self._period_us
        self._last_us, self._last_at = us, at
        self.readings_made += 1
        velocity_rad_s = raw * self._rad_s_per_raw
        told = self._told
        self._readings.append(
            Reading(
                velocity_rad_s,
                device_time_ns,
                at,
                self._position * self._rad_per_count + self._carry(us, velocity_rad_s, at),
                self.position_told_at,
                self.torque_nm,
                self.torque_told_at,
                told.statusword,
                told.at,
            )
        )

    def _carry(self, us: int, velocity_rad_s: float, at: Instant) -> float:
        """Return the angle that the shaft has turned since the last position frame until ``us``, rad.

        An overtaken reading, older than the last extrapolation, moves nothing.
        """
        if self._anchored_at >= 0:
            self._carried_to_us = us - self._periods(at - self._anchored_at) * self._period_us
            self._anchored_at = NEVER_TOLD
        passed_us = us - self._carried_to_us
        if not -self._reach_us <= passed_us <= self._reach_us:
            self._carried_to_us, passed_us = us, 0
        mean_rad_s = 0.5 * (self._velocity_rad_s + velocity_rad_s)
        carried_rad = self._carried_rad + mean_rad_s * passed_us * 1e-6
        if passed_us >= 0:
            self._carried_rad, self._carried_to_us = carried_rad, us
            self._velocity_rad_s = velocity_rad_s
        return carried_rad

    def _periods(self, gap_ns: int) -> int:
        """Return the whole SYNCs between two frames by their arrival; frames of one SYNC come within half a
        period."""
        return (gap_ns + self._period_ns // 2) // self._period_ns

    def _unwrapped(self, stamp_raw: int) -> int:
        """Unwrap the stamp, from the last reading's: 1013h wraps after 71.6 minutes."""
        if self._stamp_raw is None:
            return stamp_raw
        return self._count + (stamp_raw - self._stamp_raw + self._half_wrap) % self._wrap - self._half_wrap

    def _unwrap_position(self, raw: int) -> None:
        """Unwrap 0x6064, an INTEGER32: at 65536 counts per turn it wraps after 22 minutes of 1500 rev/min."""
        if self._position_raw is None:
            self._position = raw
        else:
            self._position += ((raw - self._position_raw + _HALF_WORD) % _WORD) - _HALF_WORD
        self._position_raw = raw

    def _subscribe(
        self, network: CanopenNetwork, plan: PdoPlan, follow: FollowWatch, stamp_index: int
    ) -> None:
        speed = plan.tpdo_with(Object.VELOCITY_ACTUAL_VALUE)
        position = plan.tpdo_with(Object.POSITION_ACTUAL_VALUE)
        assert speed is not None
        assert position is not None
        self._leads = position.cob_id <= speed.cob_id
        self._stamped = speed.place_of(stamp_index) is not None
        watched = (
            Object.TORQUE_DEMAND
            if any(pdo.synchronous and pdo.place_of(Object.TORQUE_DEMAND) is not None for pdo in plan.tpdos)
            else Object.TORQUE_ACTUAL_VALUE
        )
        for pdo in plan.tpdos:
            self._inlets[pdo.cob_id] = inlet = _Inlet(self, pdo, self._told, follow, watched, stamp_index)
            network.listen(pdo.cob_id, inlet.take)


class _Inlet:
    """Unpacks the frames of one TPDO for an assembler; objects without a use are skipped."""

    def __init__(
        self,
        assembler: ReadingAssembler,
        pdo: PdoMap,
        told: LastStatusword,
        follow: FollowWatch,
        watched: int,
        stamp_index: int,
    ) -> None:
        codec = pdo.codec()
        self.kept: list[tuple[bytes, Instant]] | None = None
        self._assembler = assembler
        self._told = told
        self._follow = follow
        self._unpack = codec.unpack
        self._size = codec.size
        self._status = _place(pdo, Object.STATUSWORD)
        self._mode = _place(pdo, Object.MODES_OF_OPERATION_DISPLAY)
        self._torque = _place(pdo, Object.TORQUE_ACTUAL_VALUE, Object.CURRENT_ACTUAL_VALUE)
        self._position = _place(pdo, Object.POSITION_ACTUAL_VALUE)
        self._velocity = _place(pdo, Object.VELOCITY_ACTUAL_VALUE)
        self._stamp = _place(pdo, stamp_index)
        self._demand = _place(pdo, Object.TORQUE_DEMAND)
        self._watched = _place(pdo, watched)
        self._on_change = not pdo.synchronous and self._demand >= 0 and self._stamp >= 0

    def take(self, data: bytes, at: Instant) -> None:
        assembler = self._assembler
        if self.kept is not None:
            self.kept.append((data, at))
        if len(data) != self._size:
            assembler.malformed += 1
            return
        fields = self._unpack(data)
        if self._on_change:
            assembler.demand_changed(fields[self._demand], fields[self._stamp], at)
            return
        if self._mode >= 0:
            self._follow.mode_told(fields[self._mode], at)
        if self._status >= 0:
            self._told.take(fields[self._status], at)
            self._told.by_pdo = fields[self._status]
            self._follow.status_told(fields[self._status], at)
        if self._torque >= 0:
            assembler.torque_told(fields[self._torque], at)
        if self._position >= 0:
            assembler.anchor_position(fields[self._position], at)
        if self._velocity >= 0:
            assembler.speed_told(fields[self._velocity], fields[self._stamp] if self._stamp >= 0 else -1, at)
        if self._demand >= 0:
            assembler.demand_told(fields[self._demand], at, self._velocity >= 0)
        if self._watched >= 0 and (watch := assembler.watch) is not None:
            assembler.tell_watch(watch, fields[self._watched])


def _place(pdo: PdoMap, *indices: int) -> int:
    """Return the position of the first of the objects found among the entries; -1 if none is mapped."""
    return next((place for index in indices if (place := pdo.place_of(index)) is not None), -1)
