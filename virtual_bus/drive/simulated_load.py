"""The load machine on a simulated drive's shaft, as 2100h commands it."""

from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.virtual_bus.core.native import CyclicDrive
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.actual_values import LOAD_NM
from servobench.virtual_bus.drive.firmware import Firmware
from servobench.virtual_bus.drive.load_object import LoadCourse, LoadTable
from servobench.virtual_bus.drive.servo_objects import ServoObjects


class SimulatedLoad:
    """A constant torque, or one over time that waits for the SYNC from which on it counts."""

    def __init__(
        self, firmware: Firmware, objects: ServoObjects, over_time: LoadTable | None, cycle: CyclicDrive
    ) -> None:
        """``over_time``: the course that it has; None: none. ``cycle``: lets SYNCs be heard of."""
        self._firmware = firmware
        self._objects = objects
        self._over_time = over_time
        self._course = int(LoadCourse.OFF)
        self._cycle = cycle
        objects.load_torque.on_write = self._on_torque
        objects.load_course.check, objects.load_course.on_write = self._check_course, self._on_course
        objects.load_course.provider = lambda: self._course

    def on_sync(self, now: Instant) -> None:
        """The SYNC at ``now`` with which the load over time begins."""
        self._cycle.awaits_sync = False
        begins = Instant(now + self._objects.load_delay.value * NS_PER_US)
        self._firmware.bear(self._over_time, self._course == LoadCourse.HELD, begins)

    def _on_torque(self, raw: int) -> None:
        self._firmware.inner.load_nm = raw * LOAD_NM

    def _check_course(self, course: int) -> AbortCode | None:
        return AbortCode.NO_DATA if course != LoadCourse.OFF and self._over_time is None else None

    def _on_course(self, course: int) -> None:
        self._course = course
        self._cycle.awaits_sync = course != LoadCourse.OFF
        self._firmware.bear(None)
        self._on_torque(self._objects.load_torque.value)
