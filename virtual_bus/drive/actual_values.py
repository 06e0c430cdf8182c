"""The actual values of every cycle, 6041h, 6064h, 606Ch and 6077h, as of the last inner tick; and those that
are seldom asked for, which are computed when they are.

The load machine on a simulated drive's shaft, as 2100h commands it.
"""

from typing import Final

from servobench.drivers.cia402.profile import Status
from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.virtual_bus.core.native import CyclicDrive, clipped
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.axis import SimulatedAxis
from servobench.virtual_bus.drive.firmware import Firmware, InnerControl
from servobench.virtual_bus.drive.load_object import LoadCourse, LoadTable
from servobench.virtual_bus.drive.servo_objects import ServoObjects
from servobench.virtual_bus.drive.user_units import UserUnits, wrapped

INTERNAL_LIMIT_ACTIVE: Final = int(Status.INTERNAL_LIMIT_ACTIVE)
_SPEED: Final = int(InnerControl.SPEED.value)


class ActualValues:
    """Where the firmware's state becomes what the TPDOs carry."""

    def __init__(self, firmware: Firmware, objects: ServoObjects, units: UserUnits) -> None:
        self._inner = inner = firmware.inner
        self._units = units
        self._objects = objects
        objects.position.provider = inner.position_told
        objects.velocity.provider = inner.velocity_told
        objects.torque.provider = inner.torque_told

    def take_units(self) -> None:
        """They have changed."""
        inner, units = self._inner, self._units
        inner.origin = units.origin
        inner.counts_per_position = units.counts_per_position
        inner.velocity_per_rad_s = units.velocity_per_rad_s
        inner.torque_unit_nm = self._objects.torque_unit_nm
        inner.range_low = float(units.low)
        inner.range_span = float(units.span) if units.ranged else 0.0


LOAD_NM: Final = 1e-3
"""Unit of 2100h."""


def provide_slow_values(axis: SimulatedAxis) -> None:
    """Demand values, current, following error and load, as of the last inner tick, but for the torque demand:
    that is what is in force now."""
    objects, motion, units, firmware = axis.objects, axis.motion, axis.units, axis.firmware
    inner = firmware.inner
    if firmware.parameters.supply is not None:
        objects.dc_link.provider = lambda: round(1000.0 * inner.link_v)
    objects.position_internal.provider = lambda: wrapped(int(inner.count - units.origin))
    objects.torque_demand.provider = inner.torque_demand_told
    objects.current.provider = lambda: clipped(inner.current_q_measured_a / objects.current_unit_a, 16)
    objects.current_d.provider = lambda: clipped(inner.current_d_measured_a / objects.current_unit_a, 16)
    objects.current_q.provider = lambda: clipped(inner.current_q_measured_a / objects.current_unit_a, 16)
    objects.voltage_d.provider = lambda: clipped(inner.next_voltage_d_v / objects.voltage_unit_v, 16)
    objects.voltage_q.provider = lambda: clipped(inner.next_voltage_q_v / objects.voltage_unit_v, 16)
    objects.current_q_demand.provider = lambda: clipped(
        inner.torque_demand_nm / firmware.motor.torque_constant_nm_a / objects.current_unit_a, 16
    )
    objects.load_torque.provider = objects.load_actual.provider = lambda: round(inner.load_nm / LOAD_NM)
    motion.position_demand.provider = lambda: units.position_of(
        inner.count if axis.demand is None else axis.demand
    )
    motion.position_demand_internal.provider = lambda: wrapped(
        round((inner.count if axis.demand is None else axis.demand) - units.origin)
    )
    motion.velocity_demand.provider = lambda: clipped(
        inner.speed_demand_rad_s * units.velocity_per_rad_s if inner.control == _SPEED else 0.0, 32
    )
    motion.vl_demand.provider = lambda: clipped(
        inner.speed_demand_rad_s / axis.rad_s_per_vl if inner.control == _SPEED else 0.0, 16
    )
    motion.vl_velocity.provider = lambda: clipped(inner.speed_measured_rad_s / axis.rad_s_per_vl, 16)
    motion.following_error.provider = lambda: clipped(axis.following_error, 32)


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
