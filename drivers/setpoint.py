"""Controlword and set-points of one drive, and the RPDOs that carry them."""

from collections.abc import Callable
from typing import Any, Final

from drivers.link import BusLink
from drivers.network import CanopenNetwork
from drivers.objects402 import Object
from drivers.pdo import PdoMap, PdoPlan
from drivers.scaling import Scaling
from drivers.timebase import Instant

_TORQUE_RAW_MAX: Final = 0x7FFF
_VELOCITY_RAW_MAX: Final = 0x7FFF_FFFF
_WORD: Final = 1 << 32
_HALF_WORD: Final = 1 << 31
_TARGET_TORQUE: Final = int(Object.TARGET_TORQUE)
_round: Final = round
"""As constants of this module: found without a look-up where it is compiled."""


class _Carrier:
    """One RPDO and its present values."""

    __slots__ = ("cob_id", "pack", "values")

    def __init__(self, pdo: PdoMap) -> None:
        self.cob_id = pdo.cob_id
        self.pack: Callable[..., bytes] = pdo.codec().pack
        self.values: list[Any] = [b"" if entry.code[-1] == "s" else 0 for entry in pdo.entries]


class _Place:
    """Where an object stands in an RPDO."""

    __slots__ = ("carrier", "place")

    def __init__(self, carrier: _Carrier, place: int) -> None:
        self.carrier = carrier
        self.place = place


class SetPoint:
    """What the drive is told each cycle. Every RPDO carries the one controlword that is in force.

    So a set-point never repeats an old controlword, in whatever number of RPDOs 0x6040 is mapped; and since
    every RPDO carries the set-points in force too, a controlword never repeats an old set-point.
    """

    __slots__ = (
        "_link",
        "_per_nm",
        "_per_rad",
        "_per_rad_s",
        "_places",
        "_torque",
        "_torque_raw_max",
        "_velocity_raw_max",
        "clipped",
    )

    def __init__(
        self,
        network: CanopenNetwork,
        plan: PdoPlan,
        scaling: Scaling,
        torque_max_nm: float | None,
        speed_max_rad_s: float | None = None,
    ) -> None:
        self.clipped = 0
        """Set-points beyond their limit."""
        self._link: BusLink = network.link
        self._per_nm = 1.0 / scaling.torque_nm
        self._per_rad_s = 1.0 / scaling.velocity_rad_s
        self._per_rad = 1.0 / scaling.position_rad
        self._torque_raw_max = _raw_limit(torque_max_nm, self._per_nm, _TORQUE_RAW_MAX)
        self._velocity_raw_max = _raw_limit(speed_max_rad_s, self._per_rad_s, _VELOCITY_RAW_MAX)
        self._places: dict[int, list[_Place]] = {}
        for pdo in plan.rpdos:
            carrier = _Carrier(pdo)
            for place, entry in enumerate(pdo.entries):
                if entry.sub == 0:
                    self._places.setdefault(entry.index, []).append(_Place(carrier, place))
        self._torque = self._places.get(Object.TARGET_TORQUE, [])

    # ---- any object -----------------------------------------------------------------------------------

    def hold(self, index: int, raw: int) -> None:
        """Put a value in force without sending it: the next frame that maps the object carries it."""
        for place in self._places.get(index, ()):
            place.carrier.values[place.place] = raw

    def send(self, index: int) -> None:
        """Send every RPDO that carries an object; nothing if none does."""
        for place in self._places.get(index, ()):
            carrier = place.carrier
            self._link.send(carrier.cob_id, carrier.pack(*carrier.values))

    def send_controlword(self, controlword: int) -> None:
        """Put a controlword in force and send every RPDO that carries it."""
        self.hold(Object.CONTROLWORD, controlword)
        self.send(Object.CONTROLWORD)

    # ---- the cyclic modes -----------------------------------------------------------------------------

    def hold_torque(self, torque_nm: float) -> None:
        """Set the torque that the next frame carries, N m. Raises ValueError for what is no number."""
        raw = _round(torque_nm * self._per_nm)
        limit = self._torque_raw_max
        if not -limit <= raw <= limit:
            raw = limit if raw > 0 else -limit
            self.clipped += 1
        for place in self._torque:
            place.carrier.values[place.place] = raw

    def send_torque(self, torque_nm: float) -> Instant:
        """Set and send; returns the instant at which the bus was given the frame.

        Raises RuntimeError if no RPDO carries 0x6071.
        """
        self.hold_torque(torque_nm)
        return self._send_first(self._torque, _TARGET_TORQUE)

    def send_speed(self, speed_rad_s: float) -> Instant:
        """As :meth:`send_torque`, for 0x60FF."""
        raw = round(speed_rad_s * self._per_rad_s)
        limit = self._velocity_raw_max
        if not -limit <= raw <= limit:
            raw = limit if raw > 0 else -limit
            self.clipped += 1
        self.hold(Object.TARGET_VELOCITY, raw)
        return self._send_first(self._places.get(Object.TARGET_VELOCITY, []), Object.TARGET_VELOCITY)

    def send_position(self, position_rad: float) -> Instant:
        """As :meth:`send_torque`, for 0x607A, which wraps as the position in a reading is unwrapped."""
        raw = (round(position_rad * self._per_rad) + _HALF_WORD) % _WORD - _HALF_WORD
        self.hold(Object.TARGET_POSITION, raw)
        return self._send_first(self._places.get(Object.TARGET_POSITION, []), Object.TARGET_POSITION)

    def _send_first(self, places: list[_Place], index: int) -> Instant:
        if not places:
            raise RuntimeError(f"no RPDO of the plan carries {index:04X}h")
        carrier = places[0].carrier
        return self._link.send(carrier.cob_id, carrier.pack(*carrier.values))


def _raw_limit(limit: float | None, per_unit: float, raw_max: int) -> int:
    return raw_max if limit is None else min(int(limit * per_unit + 1e-9), raw_max)
