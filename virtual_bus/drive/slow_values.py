"""Values of the drive that are seldom asked for, and so are computed when they are."""

from typing import Final, cast

from virtual_bus.drive.axis import SimulatedAxis
from virtual_bus.drive.motor_kernel import (
    CONTROL_SPEED,
    D_LOAD,
    S_CONTROL,
    S_COUNT,
    S_Q_MEASURED,
    S_SPEED_DEMAND,
)
from virtual_bus.drive.user_units import wrapped

LOAD_NM: Final = 1e-3
"""Unit of 2100h."""


def provide_slow_values(axis: SimulatedAxis) -> None:
    """Demand values, current, following error and load, as of the last inner tick, but for the torque demand:
    that is what is in force now."""
    objects, motion, units, firmware = axis.objects, axis.motion, axis.units, axis.firmware
    state, demand = cast("memoryview[float]", firmware.state.data), firmware.demand
    objects.position_internal.provider = lambda: wrapped(int(state[S_COUNT] - units.origin))
    objects.torque_demand.provider = lambda: clipped(firmware.torque_demand_nm / axis.torque_unit_nm, 16)
    objects.current.provider = lambda: clipped(state[S_Q_MEASURED] / objects.current_unit_a, 16)
    objects.load_torque.provider = objects.load_actual.provider = lambda: round(
        float(demand[D_LOAD]) / LOAD_NM
    )
    motion.position_demand.provider = lambda: units.position_of(
        state[S_COUNT] if axis.demand is None else axis.demand
    )
    motion.position_demand_internal.provider = lambda: wrapped(
        round((state[S_COUNT] if axis.demand is None else axis.demand) - units.origin)
    )
    motion.velocity_demand.provider = lambda: clipped(
        state[S_SPEED_DEMAND] * units.velocity_per_rad_s if state[S_CONTROL] == CONTROL_SPEED else 0.0, 32
    )
    motion.following_error.provider = lambda: clipped(axis.following_error, 32)


def clipped(value: float, bits: int) -> int:
    """``value`` rounded into a signed integer."""
    most = (1 << (bits - 1)) - 1
    return round(min(max(value, -most - 1), most))
