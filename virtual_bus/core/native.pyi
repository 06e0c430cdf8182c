"""What the core, written in C, shows to Python; the sources beside this file say how it is computed."""

SOURCES_DIGEST: str
"""Of the C that the core was built from (design.core.build)."""

def sine_cosine(angle_rad: float, /) -> tuple[float, float]:
    """Sine and cosine, error below 4e-16 for magnitudes up to 1000 rad."""

def wire_bits(field: int, data: bytes, /) -> int:
    """Bits from start of frame to end of frame, with all stuff bits.

    ``field``: the arbitration key (virtual_bus.bus.bit_length) and below it the four bits of the DLC;
    ``data``: its octets. Error: ValueError for more than eight octets.
    """

class InnerLoops:
    """The motor, the mechanics and the drive's inner loops on their grid; all zero at first.

    A period is that of the inner rate. Whoever makes one sets the parameters, then ``power_on_ns``.
    """

    # ---- motor and mechanics: parameters ----
    resistance_ohm: float
    inductance_d_h: float
    inductance_q_h: float
    flux_linkage_wb: float
    pole_pairs: float
    torque_factor: float
    inertia_kg_m2: float
    viscous_friction_nm_s: float
    coulomb_friction_nm: float
    voltage_max_v: float
    period_s: float
    per_period: float
    """Hz."""
    substeps: float
    """Steps of integration in a period."""
    step_s: float
    torque_constant_nm_a: float
    per_torque_constant: float
    per_inductance_d: float
    per_inductance_q: float
    per_inertia: float

    # ---- loops: parameters ----
    counts: float
    """Of the encoder, per turn."""
    counts_per_rad: float
    rad_per_count: float
    gain_d: float
    gain_q: float
    integral_gain: float
    per_gain_d: float
    per_gain_q: float
    decouple_d_h: float
    """Inductances that the drive decouples with, which need not be the motor's."""
    decouple_q_h: float
    speed_filter: float
    speed_gain: float
    speed_integral_gain: float
    speed_limit_gain: float
    rest_speed_rad_s: float
    brake_nm: float
    encoder_held: int
    """Not 0: the encoder's line is broken, its count stands still."""

    # ---- motor and mechanics: state ----
    current_d_a: float
    current_q_a: float
    speed_rad_s: float
    angle_rad: float
    """0 <= angle < 2 pi."""
    turns: float
    """Whole turns."""

    # ---- loops: state at the last tick ----
    voltage_d_v: float
    """Applied until the next tick, in the stator's frame; ``next_``: computed for the period after that."""
    voltage_q_v: float
    next_voltage_d_v: float
    next_voltage_q_v: float
    count: float
    """Of the encoder, without end."""
    speed_measured_rad_s: float
    current_d_measured_a: float
    current_q_measured_a: float
    torque_measured_nm: float
    torque_demand_nm: float
    speed_demand_rad_s: float
    rest_ticks: float
    """For so long the shaft has been at rest at the end of a ramp to zero."""
    limited: float
    """1: a set-point was cut at a limit."""
    braked: float
    """1: the holding brake is closed."""
    @property
    def control(self) -> int:
        """What the loops followed: ``InnerControl``."""

    # ---- demand ----
    wanted_control: int
    torque_max_nm: float
    current_max_a: float
    speed_max_rad_s: float
    load_nm: float
    """Positive opposes positive speed."""
    asked: int
    """1: a demand was written since the last tick."""

    # ---- grid ----
    power_on_ns: int
    rate_hz: int
    motion_ticks: int
    """Ticks of a motion period."""
    @property
    def ticks(self) -> int:
        """Since power-on."""

    def advance_to(self, now_ns: int, /) -> bool:
        """Run every tick up to and including ``now_ns``; False if there was none."""

    def advance_to_motion_tick(self, now_ns: int, /) -> bool:
        """Run the ticks up to the next of the motion grid, or to ``now_ns`` if that comes first; whether the
        grid was reached."""

    def tick_at(self) -> int:
        """The instant of the last tick, ns rounded down."""

    def tick_after(self, now_ns: int, /) -> int:
        """The instant of the next tick at or after ``now_ns``, ns rounded up."""

    def torque_in_force(self) -> float:
        """The torque demand in force now, N m, inside its limits."""

    def demand_torque(self, torque_nm: float, /) -> None:
        """Torque set-point; it is followed where ``wanted_control`` is torque."""

    def ramp_to_speed(self, speed_rad_s: float, acceleration_rad_s2: float, torque_feed_nm: float, /) -> None:
        """Follow a speed ramp from the present speed on."""

    def bear(self, times_s: bytes, torques_nm: bytes, held: bool, from_s: float, /) -> None:
        """Bear a load by a table of doubles, its time 0 at ``from_s`` after power-on; empty: the demand's.

        ``held``: as at the point before, not straight to the next. Error: ValueError for two lengths.
        """

    def set_controller(self, axis: int, order: int, values: bytes, /) -> None:
        """Put a current controller in state space in the place of the PI on d (0) or q (1).

        ``values``: doubles, D, then A (n x n) by rows, B, C and the take-back gain (n each). Error:
        ValueError for another count of them, or an order above 8.
        """

    def advance_motor(
        self, voltage_d_v: float, voltage_q_v: float, load_nm: float, turning: float, periods: int, /
    ) -> None:
        """The motor alone for so many periods, under a voltage in the rotor's frame at each one's start.

        ``turning``: 1 where the voltage stands still in the stator's frame, 0 where it turns with the rotor.
        """

    def state(self) -> bytes:
        """All state of motor and loops, for comparing two of them."""
