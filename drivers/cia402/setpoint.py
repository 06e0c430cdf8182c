"""Controlword and set-points of one drive, and the RPDOs that carry them."""

from typing import Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.pdo import Key, PdoPlan
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.core.native import SetPointFrame, enter, nearest
from servobench.drivers.exchange import SentCommand
from servobench.drivers.rotation import RAD_S_PER_RPM

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


class _Place:
    """The place of an object in an RPDO."""

    __slots__ = ("_hold", "_place", "await_echo", "send")

    def __init__(self, frame: SetPointFrame, place: int) -> None:
        self.send = frame.send
        self.await_echo = frame.await_echo
        self._hold = frame.hold
        self._place = place

    def hold(self, raw: int | bytes) -> None:
        self._hold(self._place, raw)


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
        self._scaling = scaling
        self._speed_max_rad_s = speed_max_rad_s
        per_nm = 1.0 / scaling.torque_nm
        self._per_nm = scaling.torque_sign * per_nm
        self._per_rad = 1.0 / scaling.position_rad
        self._torque_raw_max = _raw_limit(torque_max_nm, per_nm, _TORQUE_RAW_MAX)
        self._places: dict[Key, list[_Place]] = {}
        for pdo in plan.rpdos:
            fields = tuple((entry.bits // 8, _kind(entry.code)) for entry in pdo.entries)
            frame = SetPointFrame(network.link, pdo.cob_id, fields)
            enter(network.frame_pump.echo_handlers, pdo.cob_id, frame)
            network.frame_pump.unsent_handlers[pdo.cob_id] = frame.given_up
            for place, entry in enumerate(pdo.entries):
                key = (entry.index, entry.sub)
                self._places.setdefault(key, []).append(_Place(frame, place))
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
            place.hold(raw)

    def send(self, index: int, sub: int = 0) -> None:
        """Send every RPDO that carries an object; nothing if none does."""
        for place in self._places.get((index, sub), ()):
            place.send()

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
            place.hold(raw)
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
        first = places[0]
        command = SentCommand(sequence, raw, first.send())
        first.await_echo(command)
        return command


def _kind(code: str) -> int:
    """Return the kind of a ``struct`` code as SetPointFrame counts it: 0 unsigned, 1 signed, 2 real, 3
    octets."""
    if code[-1] == "s":
        return 3
    return 2 if code in "fd" else int(code.islower())


def _raw_limit(limit: float | None, per_unit: float, raw_max: int) -> int:
    return raw_max if limit is None else min(int(limit * per_unit + 1e-9), raw_max)
