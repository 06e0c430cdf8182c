"""What breaks or wears in a simulated drive and its machine while they run: the faults of a plan that are
physical. Nothing here raises a fault of the drive: its own protection, or its master, has to find it."""

from servobench.design.motor import UNHEATED, PmsmParameters
from servobench.virtual_bus.core.native import InnerLoops


class Damage:
    """Parts of the machine and the power stage; each is as it was made until a call here alters it."""

    def __init__(self, inner: InnerLoops, machine: PmsmParameters) -> None:
        """``inner`` is filled already; ``machine``: the motor that turns, with the heat of its file."""
        self._inner = inner
        self._motor = machine
        self._chopper_siemens = inner.chopper_siemens
        self._stiffness_nm_rad, self._damping_nm_s = inner.stiffness_nm_rad, inner.damping_nm_s
        self._half_backlash_rad = inner.half_backlash_rad
        self._magnet_a = inner.saturation_magnet_a
        self._winding_c = UNHEATED.winding_c if machine.heat is None else machine.heat.winding_c
        inner.winding_c = self._winding_c

    def open_chopper(self, opened: bool) -> None:
        """The braking resistor's line is broken: switched on, it takes nothing."""
        self._inner.chopper_siemens = 0.0 if opened else self._chopper_siemens

    def drag_brake(self, torque_nm: float) -> None:
        """The holding brake rubs with that torque while it is open."""
        self._inner.brake_drag_nm = torque_nm

    def loosen_coupling(self, share: float, backlash_rad: float) -> None:
        """The coupling has that share of its stiffness and damping, and so much play more."""
        self._inner.stiffness_nm_rad = share * self._stiffness_nm_rad
        self._inner.damping_nm_s = share * self._damping_nm_s
        self._inner.half_backlash_rad = self._half_backlash_rad + 0.5 * backlash_rad

    def soil_encoder(self, from_turn: float, to_turn: float) -> None:
        """Between these shares of a turn no edge is seen; both alike: the disc is clean, and what was lost
        stays lost."""
        counts = self._inner.counts
        self._inner.dirt_from = round(from_turn * counts)
        self._inner.dirt_width = round(to_turn * counts) - self._inner.dirt_from
        self._inner.encoder_loses = 1

    def heat_motor(
        self, resistance_factor: float, flux_factor: float, winding_c: float | None = None
    ) -> None:
        """Resistance and flux of the turning motor are so many times as large as its file has them;
        ``winding_c``: None is that of the file."""
        inner, motor = self._inner, self._motor
        inner.resistance_ohm = resistance_factor * motor.resistance_ohm
        inner.flux_linkage_wb = flux_factor * motor.flux_linkage_wb
        inner.saturation_magnet_a = flux_factor * self._magnet_a
        inner.winding_c = self._winding_c if winding_c is None else winding_c
