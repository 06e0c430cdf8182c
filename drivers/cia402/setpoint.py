"""Controlword and set-points of one drive, and the RPDOs that carry them."""

from collections.abc import Callable, Iterable
from typing import Any, Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import Key, PdoMap, PdoPlan
from servobench.drivers.canopen.sdo import object_name
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.core.native import nearest
from servobench.drivers.exchange import SentCommand
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import UNTOLD

_TORQUE_RAW_MAX: Final = 0x7FFF
_VELOCITY_RAW_MAX: Final = 0x7FFF_FFFF
_VL_RAW_MAX: Final = 0x7FFF
"""6071h and 6042h are INTEGER16, 60FFh is an INTEGER32 (CiA 402-2)."""
_WORD: Final = 1 << 32
_HALF_WORD: Final = 1 << 31
_TARGET_TORQUE: Final[Key] = (int(Object.TARGET_TORQUE), 0)
_TARGET_VELOCITY: Final[Key] = (int(Object.TARGET_VELOCITY), 0)
_TARGET_POSITION: Final[Key] = (int(Object.TARGET_POSITION), 0)
_VL_TARGET: Final[Key] = (int(Object.VL_TARGET_VELOCITY), 0)
_DATA_RECORD: Final[Key] = (int(Object.INTERPOLATION_DATA_RECORD), 1)
_round: Final = nearest
"""Module constants: found without a look-up where compiled."""
_AWAITED_MAX: Final = 256
"""Commands waiting for their echo on a bus that has none, or has stopped sending them."""
_OVERTAKEN_MAX: Final = 16
"""Commands whose echo may still come after a later one's, on a bus that delays frames by so many cycles;
older ones never reached the bus, and one of equal data must not be mistaken for them."""


class _Awaited:
    """The commands of one RPDO that wait for their echo, matched by instant of hand-over or, where the bus
    does not report that, by frame data."""

    __slots__ = ("_overtaken", "_waiting")

    def __init__(self) -> None:
        self._waiting: list[tuple[bytes, SentCommand]] = []
        self._overtaken: list[tuple[bytes, SentCommand]] = []

    def sent(self, data: bytes, command: SentCommand) -> None:
        """Note a command that was handed to the bus."""
        if len(self._waiting) == _AWAITED_MAX:
            self._waiting.pop(0)
        self._waiting.append((data, command))

    def given_up(self, handed_at: Instant) -> None:
        """Note that the frame handed over at that instant was never sent."""
        for place, (_, command) in enumerate(self._waiting):
            if command.handed_at == handed_at:
                command.unsent = True
                del self._waiting[place]
                return

    def echoed(self, data: bytes, at: Instant, handed_at: Instant) -> None:
        """Match an echo of this RPDO. Without an instant of hand-over it belongs to the first command with
        such data since the last one seen; or, if the bus let frames overtake each other, to the last one
        before. It may also belong to others waiting with the same data."""
        waiting, overtaken = self._waiting, self._overtaken
        for place, (awaited, command) in enumerate(waiting):
            if awaited == data and (handed_at == command.handed_at or handed_at == UNTOLD):
                command.on_bus_at = at
                for _ in range(place):
                    overtaken.append(waiting.pop(0))
                waiting.pop(0)
                while len(overtaken) > _OVERTAKEN_MAX:
                    overtaken.pop(0)
                if handed_at == UNTOLD:
                    _note_maybe(waiting, data, at)
                    _note_maybe(overtaken, data, at)
                return
        for place in range(len(overtaken) - 1, -1, -1):
            awaited, command = overtaken[place]
            if awaited == data and (handed_at == command.handed_at or handed_at == UNTOLD):
                command.on_bus_at = at
                overtaken.pop(place)
                if handed_at == UNTOLD:
                    _note_maybe(overtaken, data, at)
                return


def _note_maybe(commands: Iterable[tuple[bytes, SentCommand]], data: bytes, at: Instant) -> None:
    """The echo at ``at`` may be of any of ``commands`` that sent ``data``."""
    for awaited, command in commands:
        if awaited == data and command.maybe_at is None:
            command.maybe_at = at


class _Carrier:
    """One RPDO and its present values."""

    __slots__ = ("awaited", "cob_id", "pack", "values")

    def __init__(self, pdo: PdoMap) -> None:
        self.cob_id = pdo.cob_id
        self.pack: Callable[..., bytes] = pdo.codec().pack
        self.values: list[Any] = [b"" if entry.code[-1] == "s" else 0 for entry in pdo.entries]
        self.awaited = _Awaited()


class _Place:
    """The place of an object in an RPDO."""

    __slots__ = ("carrier", "place")

    def __init__(self, carrier: _Carrier, place: int) -> None:
        self.carrier = carrier
        self.place = place


class SetPointFrames:
    """The data sent to the drive each cycle. Every RPDO carries the one controlword in force.

    So a set-point never repeats an old controlword, in whatever number of RPDOs 0x6040 is mapped; and since
    every RPDO carries the set-points in force too, a controlword never repeats an old set-point.
    """

    def __init__(
        self,
        network: CanopenNetwork,
        plan: PdoPlan,
        scaling: Scaling,
        torque_max_nm: float | None,
        speed_max_rad_s: float | None = None,
    ) -> None:
        self._send_frame = network.link.send
        self._scaling = scaling
        self._speed_max_rad_s = speed_max_rad_s
        per_nm = 1.0 / scaling.torque_nm
        self._per_nm = scaling.torque_sign * per_nm
        self._per_rad = 1.0 / scaling.position_rad
        self._torque_raw_max = _raw_limit(torque_max_nm, per_nm, _TORQUE_RAW_MAX)
        self._places: dict[Key, list[_Place]] = {}
        for pdo in plan.rpdos:
            carrier = _Carrier(pdo)
            network.frame_pump.echo_handlers[pdo.cob_id] = carrier.awaited.echoed
            network.frame_pump.unsent_handlers[pdo.cob_id] = carrier.awaited.given_up
            for place, entry in enumerate(pdo.entries):
                key = (entry.index, entry.sub)
                self._places.setdefault(key, []).append(_Place(carrier, place))
        self._torque = self._places.get(_TARGET_TORQUE, [])
        self.aim(Mode.NONE)

    def aim(self, mode: Mode, vl_rad_s: float = RAD_S_PER_RPM) -> None:
        """Direct speeds and positions to the set-point of ``mode``; ``vl_rad_s``: one unit of 6042h, rad/s,
        negative if its sign is reversed."""
        velocity_mode = mode is Mode.VELOCITY
        interpolated = mode is Mode.INTERPOLATED_POSITION
        self._speed_key = _VL_TARGET if velocity_mode else _TARGET_VELOCITY
        self._position_key = _DATA_RECORD if interpolated else _TARGET_POSITION
        per_rad_s = 1.0 / (vl_rad_s if velocity_mode else self._scaling.velocity_rad_s)
        self._per_rad_s = self._scaling.velocity_sign * per_rad_s
        raw_max = _VL_RAW_MAX if velocity_mode else _VELOCITY_RAW_MAX
        self._velocity_raw_max = _raw_limit(self._speed_max_rad_s, abs(per_rad_s), raw_max)

    # ---- any object -----------------------------------------------------------------------------------

    def hold(self, index: int, raw: int | bytes, sub: int = 0) -> None:
        """Put a value in force without sending it: the next frame that maps the object carries it."""
        for place in self._places.get((index, sub), ()):
            place.carrier.values[place.place] = raw

    def send(self, index: int, sub: int = 0) -> None:
        """Send every RPDO that carries an object; nothing if none does."""
        for place in self._places.get((index, sub), ()):
            carrier = place.carrier
            self._send_frame(carrier.cob_id, carrier.pack(*carrier.values))

    def send_controlword(self, controlword: int) -> None:
        """Put a controlword in force and send every RPDO that carries it."""
        self.hold(Object.CONTROLWORD, controlword)
        self.send(Object.CONTROLWORD)

    # ---- set-points of each cycle -----------------------------------------------------------------------

    def hold_torque(self, torque_nm: float) -> int:
        """Set the torque of the next frame, N m; return it as sent. Raises ValueError for a value that is no
        number."""
        raw = _round(torque_nm * self._per_nm)
        limit = self._torque_raw_max
        if not -limit <= raw <= limit:
            raw = limit if raw > 0 else -limit
        for place in self._torque:
            place.carrier.values[place.place] = raw
        return raw

    def hold_rest(self) -> None:
        """Zero torque and speed in the frames from now on."""
        self.hold_torque(0.0)
        for key in (_TARGET_VELOCITY, _VL_TARGET):
            self.hold(key[0], 0)

    def send_torque(self, torque_nm: float, sequence: int) -> SentCommand:
        """Set and send a torque; return the command, which the bus may report on later.

        ``sequence``: the cycle that produced it. Raises RuntimeError if no RPDO carries 0x6071.
        """
        raw = self.hold_torque(torque_nm)
        return self._send_first(self._torque, _TARGET_TORQUE, raw, sequence)

    def send_speed(self, speed_rad_s: float, sequence: int) -> SentCommand:
        """Set and send a speed: 0x60FF, or 0x6042 in its whole units; otherwise like :meth:`send_torque`."""
        limit = self._velocity_raw_max
        raw = min(max(round(speed_rad_s * self._per_rad_s), -limit), limit)
        return self._send_for(self._speed_key, raw, sequence)

    def send_position(self, position_rad: float, sequence: int) -> SentCommand:
        """Set and send a position: 0x607A, or 0x60C1:1, wrapping as a reading is unwrapped; otherwise like
        :meth:`send_torque`."""
        raw = (round(position_rad * self._per_rad) + _HALF_WORD) % _WORD - _HALF_WORD
        return self._send_for(self._position_key, raw, sequence)

    def _send_for(self, key: Key, raw: int, sequence: int) -> SentCommand:
        self.hold(key[0], raw, key[1])
        return self._send_first(self._places.get(key, []), key, raw, sequence)

    def _send_first(self, places: list[_Place], key: Key, raw: int, sequence: int) -> SentCommand:
        if not places:
            raise RuntimeError(f"no RPDO of the plan carries {object_name(*key)}")
        carrier = places[0].carrier
        data = carrier.pack(*carrier.values)
        command = SentCommand(sequence, raw, self._send_frame(carrier.cob_id, data))
        carrier.awaited.sent(data, command)
        return command


def _raw_limit(limit: float | None, per_unit: float, raw_max: int) -> int:
    return raw_max if limit is None else min(int(limit * per_unit + 1e-9), raw_max)
