"""A hysteresis brake on a simulated shaft, and the loop that holds its torque."""

from typing import Final, Protocol

from drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from virtual_bus.drive.servo import SimulatedServo

STEP_NS: Final = NS_PER_MS
"""The torque loop of the brake runs so often."""
RESPONSE_S: Final = 0.03
"""Time constant with which the torque follows its set-point: chosen here, of the order of a small brake's."""
_SETTLED_NM = 1e-4


class Shaft(Protocol):
    """What a brake is coupled to."""

    def speed_rad_s(self, now: Instant) -> float:
        """Its true speed."""
        ...

    def brake(self, torque_nm: float, now: Instant) -> None:
        """Hold ``torque_nm`` against its motion from ``now`` on; at rest it sticks up to that torque."""
        ...


class ServoShaft:
    """The shaft of a simulated drive."""

    def __init__(self, servo: SimulatedServo) -> None:
        self._drive = servo.drive

    def speed_rad_s(self, now: Instant) -> float:
        self._drive.advance(now)
        return self._drive.firmware.speed_rad_s

    def brake(self, torque_nm: float, now: Instant) -> None:
        self._drive.advance(now)
        self._drive.firmware.brake_shaft(torque_nm)


class Brake:
    """Takes power from the shaft and never gives any: its torque acts against the motion, like friction."""

    def __init__(self, shaft: Shaft, torque_max_nm: float, response_s: float = RESPONSE_S) -> None:
        self.torque_nm = 0.0
        """What it holds now."""
        self._shaft = shaft
        self._torque_max_nm = torque_max_nm
        self._set_point_nm = 0.0
        step_s = STEP_NS / NS_PER_S
        self._share = step_s / (response_s + step_s)

    def set_torque(self, torque_nm: float) -> None:
        """Follow this set-point from the next step on, within what the brake can hold."""
        self._set_point_nm = min(max(torque_nm, 0.0), self._torque_max_nm)

    @property
    def settled(self) -> bool:
        """The torque is that of the set-point."""
        return self.torque_nm == self._set_point_nm

    def step(self, now: Instant) -> None:
        """One step of the torque loop."""
        if self.settled:
            return
        away = self._set_point_nm - self.torque_nm
        if abs(away) < _SETTLED_NM:
            self.torque_nm = self._set_point_nm
        else:
            self.torque_nm += self._share * away
        self._shaft.brake(self.torque_nm, now)

    def speed_rad_s(self, now: Instant) -> float:
        """Of its shaft."""
        return self._shaft.speed_rad_s(now)
