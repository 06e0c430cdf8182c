"""Turns the TPDOs of one drive into readings in SI units."""

from typing import Final

from librt.strings import read_f64_le, read_i64_le
from mypy_extensions import i64

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import PdoMap, PdoPlan
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.core.native import CommandWatch, Inlet, LastStatusword, Reception
from servobench.drivers.exchange import DemandChange, Readback, Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.vendors.stamps import STANDARD_STAMP, StampProfile

_NO_TIME: Final[i64] = -(1 << 63)
"""In the place of a stamp where the frame of the speed has none."""
_CODES: Final = "bBhHiI"
"""Types of what a reading is made of: whole numbers of at most 32 bits."""


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
        speed = plan.tpdo_with(Object.VELOCITY_ACTUAL_VALUE)
        position = plan.tpdo_with(Object.POSITION_ACTUAL_VALUE)
        assert speed is not None
        assert position is not None
        self._reception = Reception(
            scaling.velocity_sign * scaling.velocity_rad_s,
            scaling.torque_sign * scaling.torque_nm,
            scaling.position_rad,
            period_ns,
            stamp.bits,
            stamp.unit_ns,
            position.cob_id <= speed.cob_id,
            speed.place_of(stamp.index) is not None,
            told,
            follow.reports,
            network.frame_pump,
        )
        self.anchor_position = self._reception.anchor_position
        """Anchor the position: 0x6064 as read at an instant, from which positions are extrapolated."""
        self._readings = self._reception.readings
        self._readbacks = self._reception.readbacks
        self._changes = self._reception.changes
        self._inlets: dict[int, Inlet] = {}
        watched = (
            Object.TORQUE_DEMAND
            if any(pdo.synchronous and pdo.place_of(Object.TORQUE_DEMAND) is not None for pdo in plan.tpdos)
            else Object.TORQUE_ACTUAL_VALUE
        )
        for pdo in plan.tpdos:
            self._inlets[pdo.cob_id] = inlet = self._inlet(pdo, watched)
            network.listen(pdo.cob_id, inlet)

    @property
    def malformed(self) -> int:
        """PDOs whose length differs from the mapping."""
        return self._reception.malformed

    @property
    def watch(self) -> CommandWatch | None:
        """Takes in every demand, or torque, that arrives."""
        return self._reception.watch

    @watch.setter
    def watch(self, watch: CommandWatch | None) -> None:
        self._reception.watch = watch

    def tell_watch(self, watch: CommandWatch, raw: int) -> None:
        """Pass a demand or torque to the watch. A drive that itself reports not following needs no watch."""
        self._reception.tell_watch(watch, raw)

    def keep_frames(self, cob_id: int) -> None:
        """Begin to keep the frames of a TPDO, malformed ones included, for :meth:`take_frames`."""
        self._inlets[cob_id].keep()

    def take_frames(self, cob_id: int) -> bytes:
        """Return the frames since the last call, in rows (:meth:`Inlet.take_kept`); none if they are not
        kept."""
        return self._inlets[cob_id].take_kept()

    @property
    def has_readings(self) -> bool:
        """Whether readings were completed since the last call of :meth:`take`."""
        return len(self._readings) > 0

    def take(self) -> list[Reading]:
        """Return the readings completed since the last call, oldest first."""
        readings: list[Reading] = []
        for row in self._readings:
            readings.append(_reading(row))
        self._readings.clear()
        return readings

    def take_readbacks(self) -> list[Readback]:
        """Return the torque demands received with a SYNC since the last call, oldest first."""
        readbacks: list[Readback] = []
        for row in self._readbacks:
            raw, at = read_i64_le(row, 0), read_i64_le(row, 8)
            readings, in_reading = read_i64_le(row, 16), read_i64_le(row, 24) != 0
            readbacks.append(Readback(raw, Instant(at), readings, in_reading))
        self._readbacks.clear()
        return readbacks

    def take_demand_changes(self) -> list[DemandChange]:
        """Return the torque demands received on change since the last call, oldest first."""
        changes: list[DemandChange] = []
        for row in self._changes:
            raw, device_time_ns = read_i64_le(row, 0), read_i64_le(row, 8)
            changes.append(DemandChange(raw, device_time_ns, Instant(read_i64_le(row, 16))))
        self._changes.clear()
        return changes

    @property
    def torque_nm(self) -> float:
        """Last torque received; NaN before the first."""
        return self._reception.torque_nm

    @property
    def torque_told_at(self) -> Instant:
        """When it came; -1 before the first."""
        return self._reception.torque_told_at

    def position_rad(self, raw: int | None) -> float:
        """Convert a raw position near the last one to rad, on the scale of the readings; None: the last
        one."""
        return self._reception.position_rad(raw)

    def _inlet(self, pdo: PdoMap, watched: int) -> Inlet:
        fields = (
            _field(pdo, Object.STATUSWORD),
            _field(pdo, Object.MODES_OF_OPERATION_DISPLAY),
            _field(pdo, Object.TORQUE_ACTUAL_VALUE) or _field(pdo, Object.CURRENT_ACTUAL_VALUE),
            _field(pdo, Object.POSITION_ACTUAL_VALUE),
            _field(pdo, Object.VELOCITY_ACTUAL_VALUE),
            _field(pdo, self.stamp.index),
            _field(pdo, Object.TORQUE_DEMAND),
            _field(pdo, watched),
        )
        return Inlet(self._reception, pdo.bits // 8, fields, not pdo.synchronous)


def _field(pdo: PdoMap, index: int) -> tuple[int, int, bool] | None:
    """Return place and length of an object in the octets of a PDO, and whether it is signed; None: it is not
    mapped."""
    place = pdo.place_of(index)
    if place is None:
        return None
    entry = pdo.entries[place]
    if entry.code not in _CODES:
        raise ValueError(f"{index:04X}h in {pdo.name} is of type {entry.code!r}: one of {_CODES} expected")
    first = sum(before.bits for before in pdo.entries[:place]) // 8
    return first, entry.bits // 8, entry.code.islower()


def _reading(row: bytes) -> Reading:
    device_time_ns = read_i64_le(row, 24)
    return Reading(
        read_f64_le(row, 0),
        None if device_time_ns == _NO_TIME else device_time_ns,
        Instant(read_i64_le(row, 32)),
        read_f64_le(row, 8),
        Instant(read_i64_le(row, 40)),
        read_f64_le(row, 16),
        Instant(read_i64_le(row, 48)),
        read_i64_le(row, 56),
        Instant(read_i64_le(row, 64)),
    )
