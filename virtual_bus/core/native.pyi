"""The core, written in C, as seen from Python; the sources beside this file document it."""

from collections.abc import Callable, Sequence, Sized
from typing import Any, NoReturn, Protocol, Self

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import WireFrame
from servobench.virtual_bus.device.object_dictionary import Variable

SOURCES_DIGEST: str
"""Digest of the C sources of the core (servobench.design.core.build)."""

def enter(table: dict[int, Any], can_id: int, entry: object, /) -> None:
    """Set ``table[can_id]`` by the one integer that this core has of an identifier: so a frame's handlers are
    found in a third of the time."""

def sine_cosine(angle_rad: float, /) -> tuple[float, float]:
    """Sine and cosine, error below 4e-16 for magnitudes up to 1000 rad."""

def wire_bits(field: int, data: bytes, /) -> int:
    """Bits from start of frame to end of frame, with all stuff bits.

    ``field``: the arbitration key (servobench.virtual_bus.bus.frame_image) and below it the four bits of the
    DLC; ``data``: its octets. Error: ValueError for more than eight octets.
    """

def pack_frame(frame: WireFrame, at: Instant, own: bool, /) -> bytes:
    """A frame as it travels between a hub and its client (hub_record.h); ``at``: its end. Error: ValueError
    for a frame that cannot be on a bus."""

def unpack_frame(packet: bytes, /) -> tuple[WireFrame, Instant, bool]:
    """The frame, its end, and whether it is an own one. Error: ValueError for what no valid frame is packed
    to."""

def clipped(value: float, bits: int, /) -> int:
    """``value`` rounded into a signed integer of 1 to 32 bits. Error: ValueError for NaN."""

def user_position(counts: float, counts_per_position: float, /) -> int:
    """A difference of encoder counts in position units, as the INTEGER32 that wraps. Error: ValueError for
    what is not finite."""

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

    # ---- iron that saturates: parameters, of virtual_bus/core/saturation.h ----
    saturated: int
    saturation_per_d: float
    saturation_per_q: float
    saturation_magnet_a: float
    saturation_knee_wb2: float
    saturation_strength: float

    # ---- the motor as the drive believes it, and what it makes of a torque: virtual_bus/core/field.h ----
    believed_flux_wb: float
    believed_saliency_h: float
    believed_resistance_ohm: float
    believed_inductance_q_h: float
    believed_inertia_kg_m2: float
    field_active: int
    """0: the d current stays at zero."""
    field_per_step: float
    field_voltage_share: float
    field_gain: float
    field_speed_min_rad_s: float
    field_floor_a: float
    field_weakest_a: float
    field_torque_per_wb: float
    field_calm_rad_s: float
    """Of the shaft; faster, a period takes ``field_fast_steps`` of integration, not ``field_calm_steps``."""
    field_calm_steps: float
    field_fast_steps: float
    weaker_a: float
    """The d current of the weakening, 0 or less."""

    # ---- between rotor and load: parameters ----
    mechanism: int
    """0: one rigid shaft, and nothing else of this part counts."""
    coupled: int
    """1: two masses."""
    encoder_on_load: int
    friction_on_load: int
    per_inertia_rotor: float
    per_inertia_load: float
    stiffness_nm_rad: float
    damping_nm_s: float
    half_backlash_rad: float
    yield_s: float
    """Damping over stiffness."""
    backward_more_nm: float
    """Coulomb friction at negative speed, above that at positive."""
    rubs_per_load: float
    bristle_nm_rad: float
    """Of the friction's bristles; 0: it goes by the speed alone."""
    bristle_nm_s: float
    """Coulomb friction that each N m of the load adds."""
    breakaway_more_nm: float
    per_stribeck: float
    """s/rad."""

    # ---- load by place and speed: parameters ----
    placed_load: int
    """0: none, and nothing of it counts."""
    hanging_nm: float
    arm_nm: float
    """Torque of an arm that lies level."""
    arm_per_turn: float
    """Turns of the arm for each of the motor."""
    arm_turns: float
    """Place of the arm at power-on; 0: it hangs down."""
    repeats_turns: float
    """Period of the table; 0: it ends."""
    end_stops: int
    """0: none."""
    stop_negative_turns: float
    """Where it is touched, turns of the motor since power-on; infinite: no stop at that end."""
    stop_positive_turns: float
    stop_stiffness_nm_rad: float
    stop_damping_nm_s: float
    stop_yield_s: float
    """Damping over stiffness."""

    # ---- between torque demand and current loops: parameters ----
    torque_path: int
    """0: the demand is made as it is."""
    torque_step_nm: float
    """That a torque set-point goes in a tick at most; 0: at once."""
    low_gain: float
    """1: no low pass."""
    notch_b0: float
    notch_b1: float
    notch_b2: float
    notch_a1: float
    notch_a2: float

    # ---- switches: parameters ----
    switches: int
    """0: nobody watches them."""
    switch_bounce_s: float
    switch_bounces: int
    """1..8."""
    switch_filter_s: float
    switch_seed: int

    # ---- DC link: parameters ----
    supplied: int
    """0: the link is a source without end, and nothing of this part counts."""
    feeds_back: int
    source_v: float
    """Also with ``supplied`` 0: what the protection then sees."""
    source_siemens: float
    capacitance_f: float
    chopper_siemens: float
    chopper_on_v: float
    chopper_off_v: float
    idle_w: float
    circle_share: float
    """The largest voltage of the motor over the link's."""
    link_steps: float
    """Steps of integration in a period."""
    link_step_s: float

    # ---- protection: parameters; currents are amplitudes in the motor's transform ----
    phase_amplitude: float
    """A of a phase over A of the motor's transform."""
    sensors: int
    """0: the currents are known as they are; the next seven then count for nothing."""
    sensor_scale_a: float
    """Told over true, in phase a; the next one in phase b."""
    sensor_scale_b: float
    sensor_offset_a: float
    """In phase a, A; the next one in phase b."""
    sensor_offset_b: float
    sensor_range_a: float
    """A of a phase, as are the next two."""
    sensor_step_a: float
    """0: none."""
    sensor_noise_a: float
    """rms."""
    sensor_delay_share: float
    """Of an inner period."""
    sensor_seed: int
    dead_share: float
    """What dead time takes of an inner period after compensation; 0: none."""
    zero_band_a: float
    output_share: float
    """Share of the voltage circle that is used."""
    protected: int
    over_v: float
    under_v: float
    over_a2: float
    continuous_a: float
    continuous_a2: float
    overload_max_a2s: float
    """I^2 t above the continuous current, A^2 s."""
    warning_a2s: float
    clear_a2s: float
    winding_max_c: float
    missing_max: float
    """Encoder counts that may be missing between two index pulses."""
    overload_trips: int
    watch_period_s: float
    stage_heats: int
    """0: the power stage stays cold."""
    stage_share: float
    """Share of the way to where its temperature settles, that it goes in a period."""
    ambient_c: float
    rise_k_a2: float
    """K for each A^2, for ever."""
    stage_max_c: float
    stage_clear_c: float
    derate_from_c: float
    derate_a_k: float
    """Largest current from there on, A for each kelvin below ``stage_max_c``."""

    # ---- loops: parameters ----
    commutation_active: int
    """0: the drive turns its currents by the encoder's angle, and that is right."""
    lines_mirrored: int
    """1: the drive takes two swapped lines of the motor for right, or the other way round."""
    angle_forced: int
    """1: the electrical angle is ``forced_rad``."""
    commutation_pole_pairs: float
    """As the drive is set."""
    commutation_ahead_rad: float
    """Of the encoder's electrical angle beyond the rotor's."""
    forced_rad: float
    counts: float
    """Counts of the encoder per turn."""
    counts_per_rad: float
    rad_per_count: float
    encoder_active: int
    """0: an ideal encoder, its speed by the difference of counts, and nothing of this part counts."""
    encoder_distorted: int
    """1: it sees the shaft elsewhere than it is."""
    encoder_sines: int
    """1: the signals of a line are a sine and a cosine with errors."""
    speed_method: int
    """0: difference of counts, 1: time between edges, 2: observer."""
    lines: float
    sine_offset: float
    """Share of the cosine's amplitude, as are the next three."""
    cosine_offset: float
    sine_in_phase: float
    sine_across: float
    eccentricity_rad: float
    eccentricity_phase_rad: float
    delay_share: float
    """Of an inner period, 0 to 1."""
    timer_hz: float
    """0: edges are timed without steps."""
    observer_position_gain: float
    """1/s."""
    observer_speed_gain: float
    """1/s^2."""
    encoder_loses: int
    """Not 0: edges go unseen, or did."""
    dirt_from: float
    """Where on the disc they do, counts within a turn."""
    dirt_width: float
    """0: nowhere."""
    counts_lost: float
    """Since power-on."""
    counts_missing: float
    """At the last index pulse, since the one before."""
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
    brake_open_ticks: float
    brake_close_ticks: float
    brake_drag_nm: float
    """Torque of a brake that does not let go wholly."""
    brake_order: int
    """:class:`servobench.virtual_bus.drive.machine.BrakeOrder`."""
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
    load_speed_rad_s: float
    twist_rad: float
    """Rotor's angle less the load's."""
    bristle_rad: float
    """By which the friction's bristles are bent."""
    stop_touched: float
    """1 or -1: the load is at an end stop."""
    stop_hits: float
    """How often an end stop has been hit."""
    stop_hit_rad_s: float
    """Speed of the load at the last hit."""

    # ---- DC link and protection: state ----
    link_v: float
    chopping: float
    """1: the chopper is closed."""
    supplied_j: float
    """Energy from the source into the link, J."""
    chopped_j: float
    """Energy from the link into the chopper's resistor, J."""
    overload_a2s: float
    limiting: float
    """1: the current is limited to the continuous one."""
    warning: float
    winding_c: float
    """Temperature that the motor's sensor tells."""
    stage_c: float
    """Temperature of the power stage."""
    derated: float
    """1: its largest current is less for that."""
    trip: int
    """:class:`servobench.virtual_bus.drive.power_stage.Trip`; 0 resets."""

    # ---- loops: state at the last tick ----
    voltage_d_v: float
    """Applied until the next tick, in the stator's frame; ``next_``: computed for the period after that."""
    voltage_q_v: float
    next_voltage_d_v: float
    next_voltage_q_v: float
    count: float
    """Count of the encoder, unlimited."""
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
    brake_holds: float
    """1: the holding brake is closed."""
    @property
    def control(self) -> int:
        """Control mode of the loops: ``InnerControl``."""

    # ---- demand ----
    wanted_control: int
    torque_up_nm: float
    torque_down_nm: float
    """Most of either sign."""
    current_max_a: float
    speed_max_rad_s: float
    load_nm: float
    """Positive opposes positive speed."""
    asked: int
    """1: a demand was written since the last tick."""

    # ---- units of the master ----
    origin: float
    """Encoder count of its position 0."""
    counts_per_position: float
    velocity_per_rad_s: float
    torque_unit_nm: float
    range_low: float
    range_span: float
    """607Bh, user units; 0: positions wrap as an INTEGER32."""

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

    def position_told(self) -> int:
        """6064h as of the last tick. Error: ValueError where the state is no finite number, as for the next
        three."""

    def velocity_told(self) -> int:
        """606Ch as of the last tick."""

    def torque_told(self) -> int:
        """6077h as of the last tick."""

    def torque_demand_told(self) -> int:
        """6074h as it is in force now."""

    def is_limited(self) -> bool:
        """Whether a set-point was cut at the last tick."""

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

    def set_least_currents(self, currents_a: bytes, /) -> None:
        """The d currents of the least amplitude over torque, from 0 on: doubles. Error: ValueError."""

    def tabulate_errors(self) -> None:
        """Make the tables of the encoder's errors of what is set."""

    def set_cogging(self, torques_nm: bytes, /) -> None:
        """Cogging over a turn of the rotor: doubles, the first once more at the end. Error: ValueError."""

    def set_load_table(self, places: int, speeds: int, table: bytes, /) -> None:
        """Load over place and speed: doubles, the places, turns, and the speeds, rad/s, both rising, and the
        torques, N m, place by place. Error: ValueError for another count."""

    def set_switch(self, which: int, low_turns: float, high_turns: float, /) -> None:
        """Where the load makes one of three switches: from the first place on, and before the second, turns
        of the motor since power-on. Its contact rests at once. Error: ValueError for another switch."""

    def switch_seen(self, which: int, /) -> bool:
        """Whether the drive sees it made as of the last tick. Error: ValueError for another switch."""

    def advance_motor(
        self, voltage_d_v: float, voltage_q_v: float, load_nm: float, turning: float, periods: int, /
    ) -> None:
        """The motor and what it turns for so many periods, under a voltage in the rotor's
        frame at the start of each.

        ``turning``: 1 where the voltage stands still in the stator's frame, 0 where it turns with the rotor.
        """

    def state(self) -> bytes:
        """All state of motor and loops, for comparing two of them."""

class Event:
    """An entry of a timeline that can be taken back; it runs once or never."""

    @property
    def pending(self) -> bool:
        """True while the event has not run."""

    def cancel(self) -> None:
        """Take the event back; no effect once it has run."""

class Timeline:
    """An event heap with a present instant that never runs backwards.

    What a callback raises comes out of the call that let time pass; the other events stay.
    """

    @property
    def now(self) -> Instant: ...
    def call_at(self, when: Instant, callback: Callable[[Instant], object], /) -> Event:
        """Run ``callback(now)`` at ``when``; an instant that has passed means: at once, at ``now``."""

    def post(self, when: Instant, callback: Callable[[Instant], object], /) -> None:
        """As ``call_at``, for what is never taken back."""

    def next_at(self) -> Instant | None:
        """The instant of the next event; None if there is none left."""

    def step(self) -> bool:
        """Go to the next event and run it; False if there is none left."""

    def run_until(self, when: Instant, /) -> None:
        """Run every event up to and including ``when``, then stand at ``when``."""

    def run_until_filled(self, when: Instant, inbox: Sized, /) -> bool:
        """As ``run_until``, but stop after the event that puts something into ``inbox``; whether there is
        something in it. It lets no more time pass than the frame needed."""

class SimulatedClock:
    """The bench's clock on a timeline: to sleep is to let the events happen."""

    def __init__(self, timeline: Timeline, /) -> None: ...
    @property
    def timeline(self) -> Timeline: ...
    def now(self) -> Instant:
        """The present instant of the timeline, ns."""

    def sleep_until(self, when: Instant, /) -> None:
        """Run the timeline up to ``when``; at once if it has passed."""

LONGEST_FRAME_BITS: int
"""Extended, eight data bytes, as many stuff bits as there can be."""
INTERMISSION_BITS: int
"""Recessive bits between the end of a frame and the next start of frame."""
TRANSMIT_QUEUE_MAX: int
RECEIVE_QUEUE_MAX: int
HUB_FRAME_BYTES: int
"""Of a frame between a hub and its client (hub_record.h); no other packet is as long, or a multiple of it."""
HUB_PACKET_BYTES_MAX: int
"""Some 17 frames: a packet of the size that the kernel allocates for it in one piece."""
HELD_MAX: int
CHECKPOINTS_MAX: int

class BusLoad:
    """Bus load over any past interval, from a bounded number of checkpoints: exact for the first 4096 frames,
    later good to the frames between two checkpoints, at worst one in 2048 of the whole run."""

    def __new__(cls, bitrate_bit_s: int = 0, /) -> Self:
        """``bitrate_bit_s``: of a bus whose frames a link shows to it. Error: ValueError below 0."""

    @property
    def way(self) -> object:
        """A capsule by which a link shows its frames (design/core/frames.h)."""

    def show(self, frame: WireFrame, sent: bool, at: Instant, /) -> None:
        """The same from Python: a frame ended at ``at``; one that is told late, where the last one did.

        Error: ValueError without a bit rate, and for a frame that no bus carries.
        """

    @property
    def busy_ns(self) -> Duration:
        """In all."""

    def add(self, duration_ns: int, end: Instant, /) -> None:
        """The bus was busy for so long up to ``end``; ends never decrease."""

    def busy_until(self, when: Instant, /) -> int:
        """Cumulated busy time at ``when``, ns; a busy spell lies at the end of its interval."""

    def percent(self, since: Instant, until: Instant, /) -> float:
        """Load between two instants, percent; 0 for an empty interval."""

class Hearer(Protocol):
    """The owner of a port."""

    def on_frame(self, frame: WireFrame, now: Instant, /) -> None:
        """Another port's frame ended at ``now``."""

class Handling(Protocol):
    """In charge of the arbitration once something may go wrong with a frame or a port."""

    def choose(self) -> None:
        """Let the port begin that can do so first and, among several, wins the arbitration."""

class Segment:
    """A bus of one bit rate on a timeline, with any number of ports; see segment.c."""

    def __new__(cls, timeline: Timeline, bitrate_bit_s: int, /) -> Self:
        """Error: ValueError for a bit rate that is not positive."""

    frames: int
    """Frames that ended."""
    free_at: Instant
    """End of the last intermission."""
    delivering: bool
    """A frame is being handed out: no other is chosen meanwhile."""
    @property
    def timeline(self) -> Timeline: ...
    @property
    def ports(self) -> tuple[Any, ...]:
        """Those that are attached, in their order."""

    @property
    def monitors(self) -> tuple[Callable[[WireFrame, Instant], None], ...]: ...
    @property
    def handling(self) -> Any | None: ...
    @property
    def bitrate_bit_s(self) -> int: ...
    @property
    def intermission_ns(self) -> Duration: ...
    @property
    def start_at(self) -> Instant:
        """Of the frame that is being sent or comes next."""

    @property
    def end_at(self) -> Instant: ...
    @property
    def load(self) -> BusLoad:
        """Of completed frames and the intermission after each."""

    def add_port(self, port: Port, /) -> None: ...
    def remove_port(self, port: Port, /) -> None: ...
    def add_monitor(self, on_frame: Callable[[WireFrame, Instant], None], /) -> None:
        """Show every frame, whoever sent it, to ``on_frame`` at its end."""

    def hand_over(self, handling: Handling, /) -> tuple[Any | None, tuple[Any, ...]]:
        """Let ``handling`` choose from now on; the port that was sending or chosen, and those that wait."""

class Port:
    """A node's connection to a segment: a first-in first-out transmit queue of 256 frames and a listener."""

    def __init__(self, segment: Segment, rank: int, name: str, listener: Hearer, /) -> None: ...
    listener: Hearer | None
    """Gets every other port's frame; None: detached."""
    on_sent: Callable[[WireFrame, Instant], None] | None
    room: int
    """Frames that it holds at most; 0: it is bus-off."""
    @property
    def name(self) -> str: ...
    @property
    def rank(self) -> int: ...
    @property
    def pending(self) -> int:
        """Frames that wait for the bus, the one being sent included."""

    @property
    def head(self) -> WireFrame | None:
        """The first of them."""

    @property
    def key(self) -> int | None:
        """Its arbitration key (servobench.virtual_bus.bus.frame_image)."""

    def send(self, frame: WireFrame, /) -> None:
        """Queue ``frame``. Raises what ``refusal()`` of the class on top returns, if it is full, off or
        detached; ValueError for a frame that is none of classical CAN."""

    def hear_only(self, heard: dict[int, Any], seat: DeviceSeat | None, /) -> None:
        """Hand only those data frames to the listener whose identifier, of 11 bits, is in ``heard`` then; or
        to the device of ``seat``, for the handlers that are there."""

    def take_head(self) -> WireFrame | None:
        """Error: ValueError while no error handling is in charge."""

    def clear(self) -> None:
        """Forget what is queued. Error: ValueError while no error handling is in charge."""

class HeldFrames:
    """Let go in the order of their release, those of one instant in the order in which they came.

    4096 at most: both TPDOs of a cycle of 1 ms for two seconds.
    """

    overflow: int
    """Frames lost because too many were held."""
    def __len__(self) -> int: ...
    def hold(self, frame: WireFrame, release: int, mark: int = 0, /) -> bool:
        """Keep ``frame`` until ``release`` (an Instant); False if there is no room. ``mark``: the owner's."""

    def next_at(self) -> int:
        """When the next one goes; NEVER if none is held."""

    def take(self, now: int, /) -> tuple[int, int, WireFrame, int] | None:
        """The next one that goes by ``now``: release, order, frame, mark."""

    def clear(self) -> None:
        """Forget all that is held."""

BLOCK_ENTRIES: int
"""Entries of an EntryBlock."""
INDEPENDENT: int
"""Shapes of a Strike; see strikes.c."""
NUMBERED: int
BURST: int
PERIODIC: int
FIRST: int

class UniformNumbers:
    """Numbers even in [0, 1), drawn a block at a time."""

    def __new__(cls, refill: Callable[[], bytes], /) -> Self:
        """``refill``: gives the next block, doubles in this machine's order."""

    def draw(self) -> float:
        """The next number. Error: ValueError for a block that is empty or has one outside [0, 1)."""

class Strike:
    """A fault that strikes frames. A class on top of it chooses a shape, or has ``strikes`` and ``number`` of
    its own."""

    def __init__(self, kind: str, window: tuple[int, int], /) -> None:
        """``kind``: of its entries in the log, which says what goes on in place of a struck frame;
        ``window``: the first ns in which it acts, and the first in which it does so no more."""

    @property
    def kind(self) -> str: ...
    @property
    def begin(self) -> int: ...
    @property
    def end(self) -> int: ...
    @property
    def value(self) -> float:
        """The second draw for the last frame."""

    def by_chance(self, shape: int, numbers: UniformNumbers, /, *chances: float) -> None:
        """INDEPENDENT and NUMBERED: the probability; BURST: of leaving the good state and the bad, then of
        losses in each."""

    def numbered(self, least: int, width: int, /) -> None:
        """Its number is one of ``width`` from ``least`` on, which may be NONE. Error: ValueError below
        that."""

    def by_count(self, shape: int, count: int, /) -> None:
        """PERIODIC: all but one of so many; FIRST: so many. Error: ValueError for less than 1."""

    def strikes(self, elapsed: int, /) -> bool:
        """Whether it strikes the frame that is there now; asked once for each."""

    def number(self) -> int:
        """The first number of the entry for the frame just struck; NONE if the frame is lost after all."""

class Hold:
    """A fault that delays frames. A class on top of it chooses how, or has ``holds`` of its own."""

    def __init__(self, window: tuple[int, int], in_order: bool, /) -> None:
        """``in_order``: frames of a link may not overtake one another."""

    @property
    def begin(self) -> int: ...
    @property
    def end(self) -> int: ...
    @property
    def in_order(self) -> bool: ...
    def uniform(self, numbers: UniformNumbers, least: int, width: int, /) -> None:
        """Any time from ``least`` on, ``width`` of them, all alike."""

    def measured(self, numbers: UniformNumbers, edges_ns: Sequence[int], counts: Sequence[int], /) -> None:
        """A bar of a histogram by its count, then a time within it."""

    def holds(self, elapsed: int, /) -> int:
        """For how many ns it holds the frame that is there now; asked once for each."""

class Queue:
    """The order of one link: no frame leaves before the one in front of it."""

    def __init__(self) -> None: ...
    released_at: int
    def behind(self, release: int, /) -> int:
        """``release``, or later if the one in front is held for longer; the next one waits for it."""

class Route:
    """All that can befall the frames of one COB-ID in one direction."""

    def __new__(cls, queue: Queue | None, strikes: Sequence[Strike], holds: Sequence[Hold], /) -> Self:
        """``queue``: None where frames may overtake one another, or are never held. Of several strikes the
        first counts."""

    seen: int
    struck: str | None
    """The kind of fault that struck the last frame, as its log entry has it."""
    number: int
    """The first number of that entry."""
    @property
    def queue(self) -> Queue | None: ...
    def meet(self, elapsed: int, n: int, /) -> int:
        """For how many ns the ``n``-th frame is held, and what strikes it; asked once for each."""

class EntryBlock:
    """So many entries of a log of faults."""

    def __init__(self) -> None: ...
    def note(
        self, code: int, at_ns: int, link: int, can_id: int, n: int, a: int = 0, b: int = 0, c: int = 0, /
    ) -> None:
        """Add an entry, see servobench.virtual_bus.faults.fault_log.FaultEntry; the last that has room calls
        ``flush``."""

    def take(self) -> bytes:
        """What it holds; it is empty then."""

    def flush(self) -> None:
        """Take what it holds. Override."""

class Fates:
    """The fate of each frame by the route of its COB-ID; a class on top of it makes the routes."""

    def __init__(self, log: Any, place: int, delay_code: int, /) -> None:
        """``log``: an EntryBlock, or None. ``place``: added to the way in an entry; ``delay_code``: of the
        entry of a delay."""

    @property
    def log(self) -> Any:
        """As it was given."""

    @property
    def zero(self) -> Instant:
        """The plan's time zero."""

    def start(self, now: Instant, /) -> None:
        """Time zero is ``now``; routes and counts begin anew."""

    def stop(self) -> None:
        """From here on every frame passes. What is already held is not let go earlier."""

    def hold(self, way: int, can_id: int, now: Instant, extended: bool, /) -> int:
        """See servobench.virtual_bus.bus.judge; every frame passes before ``start``."""

    def tally(self, way: int, /) -> tuple[int, int]:
        """Frames seen, those delayed."""

GAP: int
UNSIGNED: int
SIGNED: int
REAL: int

class PdoCodec:
    """The objects mapped into a PDO, and its octets."""

    def __new__(cls, fields: Sequence[tuple[Variable | None, int, int]], provided: bool, /) -> Self:
        """``fields``: a variable, its bits, and the kind of its numbers: GAP, UNSIGNED, SIGNED or REAL.
        ``provided``: a variable may have a provider, which is asked in place of its value. Error: ValueError
        for more than 64 bits in all."""

    def pack(self) -> bytes:
        """Sample the variables. Error: ValueError for a value that has no room."""

    def unpack(self, data: bytes, /) -> tuple[Any, ...]:
        """The values of the variables. Error: ValueError for fewer octets."""

    def changed(self) -> bool:
        """Sample the variables; whether one differs from the last call, before the first from 0."""

class CyclicDrive:
    """A drive's inner loops carried along, and the statusword; see drive_type.c."""

    def __new__(
        cls,
        loops: InnerLoops,
        statusword: Variable,
        run_mode: Callable[[Instant], bool],
        stop_on: Callable[[], None],
        tell_protection: Callable[[], None],
        /,
    ) -> Self: ...
    base_status: int
    """6041h but for bit 11, internal limit active, which the loops add."""
    wake_at: Instant
    """When it wants to be advanced without being asked."""
    wake_ns: Duration
    """So long after it was."""
    tasked: bool
    """A mode runs once per motion period, by ``run_mode``; that tells whether it is followed still."""
    stopping: bool
    """The shaft is being brought to rest: ``stop_on`` is called when it has turned on."""
    protects: bool
    """``tell_protection`` is called after each refresh."""
    awaits_sync: bool
    """The application is to hear of SYNCs."""
    def advance(self, now: Instant, /) -> None:
        """Bring loops, shaft and statusword to ``now``."""

    def refresh(self) -> None:
        """Write the statusword as of the last inner tick."""

class CyclicDevice:
    """What each cycle asks of a CANopen device; see device.c."""

    def __new__(cls, application: Any, /) -> Self: ...
    drive: CyclicDrive | None
    """Advanced in the place of the application."""
    now: Instant
    """The instant of the last entry."""
    booting: bool
    """It hears and sends nothing until its boot-up message."""
    mute: bool
    """Nothing may be sent: the bit rate is being changed."""
    operational: bool
    """PDOs are alive."""
    takes_syncs: bool
    """PRE-OPERATIONAL or OPERATIONAL."""
    @property
    def due_at(self) -> Instant:
        """The earliest timer of the device or wish of its application; now, if frames are waiting; NEVER."""

    def carry(self, transmit: Sequence[CyclicTpdo], receive: Sequence[CyclicRpdo], /) -> None:
        """Have these PDOs."""

    def watch(self, tpdo: CyclicTpdo, /) -> None:
        """Changes of what it maps are events from now on."""

    def unwatch(self, tpdo: CyclicTpdo, /) -> None:
        """Undo ``watch``."""

    def hear(self, handlers: tuple[Any, ...], frame: WireFrame, now: Instant, /) -> Sequence[WireFrame]:
        """A frame that ``handlers`` listen to; the frames to send."""

    def wake(self, now: Instant, /) -> Sequence[WireFrame]:
        """Advance, run the timers that are due, look for changes; the frames to send."""

    def advance(self, now: Instant, /) -> None:
        """Bring what is behind the device to ``now``."""

    def sync(self, counter: int, /) -> None:
        """Act on a SYNC; ``counter``: 0 without one."""

    def open_window(self, is_open: bool, /) -> None:
        """Synchronous window length, 1007h: outside of it synchronous RPDOs are discarded."""

    def send(self, frame: WireFrame, /) -> None:
        """Queue a frame to send."""

    def take_frames(self) -> Sequence[WireFrame]:
        """Look for changes; the frames to send, which are the caller's from now on."""

    def forget_frames(self) -> None:
        """Send none of those that wait."""

class Timer:
    """One deadline of a device."""

    def __new__(cls, device: CyclicDevice, callback: Callable[[Instant], None], /) -> Self: ...
    @property
    def due(self) -> Instant:
        """NEVER while it is stopped."""

    def start(self, due: Instant, /) -> None:
        """Have the callback called at ``due``; replaces an earlier deadline."""

    def stop(self) -> None:
        """Forget the deadline."""

class CyclicTpdo:
    """One TPDO's turn at a SYNC or a change; see tpdo_type.c."""

    def __new__(
        cls, device: CyclicDevice, on_event: Callable[[Instant], None], sample: PdoCodec, watch: PdoCodec, /
    ) -> Self:
        """``on_event``: a change of what ``watch`` has, unless the type is 0."""

    can_id: int
    type: int
    """Transmission type."""
    left: int
    """SYNCs until it is sent, of type 1 to 240."""
    start_at: int
    """The counter of the SYNC at which it begins; 0: at any."""
    follows_sync: bool
    """A SYNC affects it."""
    event: bool
    """There is something to send: at the next SYNC, or when the inhibit time is over."""
    runs: bool
    """What it maps changes by time or motion, not only when the device does something."""
    def map(self, sample: PdoCodec, watch: PdoCodec, /) -> None:
        """What it maps, and those of it whose change is an event."""

    def latch(self) -> None:
        """Sample."""

    def look(self) -> None:
        """What it looks at counts as seen."""

    def transmit(self) -> None:
        """Sample and send."""

    def send_latched(self) -> None:
        """Send the last sample."""

class CyclicRpdo:
    """One RPDO's reception, a handler of frames; see rpdo_type.c."""

    def __new__(
        cls,
        device: CyclicDevice,
        judge_length: Callable[[int], None],
        deadline: Timer,
        deadline_met: Callable[[], None],
        codec: PdoCodec,
        /,
    ) -> Self:
        """``judge_length``: of a frame with another length, or behind one with another. ``deadline``: runs
        from the last reception. ``deadline_met``: called at one after ``missed``."""

    deadline_ns: Duration
    """0: there is none."""
    missed: bool
    """The deadline has passed since the last reception."""
    synchronous: bool
    """It takes effect at the next SYNC."""
    wrong_length: int
    """The emergency in force, or 0."""
    @property
    def length(self) -> int:
        """Octets that it maps."""

    def map(self, codec: PdoCodec, /) -> None:
        """What it maps."""

    def take(self, frame: WireFrame, now: Instant, /) -> None:
        """Act on a frame that was held back; ``now``: that of the device's last entry."""

    def forget_waiting(self) -> None:
        """What waits for a SYNC does not take effect."""

class DeviceClock:
    """A device's own clock, and how 1013h tells of it; see device_clock_type.c."""

    def __new__(
        cls,
        device: CyclicDevice,
        offset_ns: int,
        drift_ppb: int,
        unit_ns: int,
        resolution_ns: int,
        bits: int,
        late_ns: int,
        runs: bool,
        tick_after: Callable[[Instant], Instant] | None,
        /,
    ) -> Self:
        """``offset_ns``: what it shows at power-on and after each reset. ``tick_after``: the next tick of the
        inner loops, where stamps are latched at it."""

    at_arrival: bool
    """Stamps are latched when the SYNC comes."""
    def start(self, now: Instant, /) -> None:
        """Power-on or reset of the node: the counter begins anew; its oscillator runs as it did."""

    def told(self) -> int:
        """1013h, UNSIGNED32, as it is told at the device's instant."""

    def write(self, stamp: int, /) -> None:
        """1013h is written: what was latched last counts as ``stamp``."""

    def local_ns(self, now: Instant, /) -> int:
        """The clock's time at ``now``, ns, not wrapped."""

    def step(self, step_ns: int, /) -> None:
        """The clock jumps ahead by ``step_ns``, or back."""

    def drift_more(self, drift_ppb: int, now: Instant, /) -> None:
        """From ``now`` on the clock runs faster by ``drift_ppb`` than it did; it does not jump."""

class SyncTaker:
    """What a SYNC is checked for, and what it sets off; a handler of frames. See sync_type.c."""

    def __new__(
        cls,
        device: CyclicDevice,
        clock: DeviceClock,
        judge_length: Callable[[int], None],
        hold: Callable[[int, Instant], None] | None,
        /,
    ) -> Self:
        """``judge_length``: as of an RPDO. ``hold``: takes counter and instant of a SYNC that is acted on
        later."""

    length: int
    """1: with a counter (1019h); else 0."""
    wrong_length: bool
    open_window: Callable[[Instant], None] | None
    """Called at each SYNC."""

class DeviceSeat:
    """A device's place on a segment in simulated time; see seat_type.c."""

    def __new__(
        cls,
        device: CyclicDevice | None,
        port: Port,
        failure: type[Exception],
        wake: Callable[[Instant], None],
        /,
    ) -> Self:
        """``failure``: of a port that takes no frame. ``wake``: called by the timeline."""

    scheduled: Instant
    """The earliest call of ``wake`` to come."""
    @property
    def frames_lost(self) -> int:
        """Frames that the port did not take."""

    def send(self, frame: WireFrame, /) -> None:
        """Queue a frame; one that the port does not take is lost."""

    def wake_by(self, due: Instant, /) -> None:
        """Have ``wake`` called by then."""

class FrameJudge(Protocol):
    """See servobench.virtual_bus.bus.judge."""

    def hold(self, way: int, can_id: int, now: Instant, extended: bool, /) -> int: ...
    def replacements(self, frame: WireFrame, /) -> Sequence[tuple[WireFrame, Duration]]: ...

class HostPlace:
    """A participant's inbox, of 65 536 frames, and the faults in front of it and of its sending; see
    host_place.c. It is the listener of its port."""

    def __init__(self, timeline: Timeline, /) -> None: ...
    accepts: Callable[[WireFrame], bool] | None
    """Acceptance filter, in front of the faults."""
    closed: bool
    """Nothing that was held comes in any more."""
    @property
    def held_in(self) -> HeldFrames: ...
    @property
    def held_out(self) -> HeldFrames: ...
    @property
    def overruns(self) -> int:
        """Frames lost because nobody fetched them."""

    def __len__(self) -> int:
        """Frames that wait in the inbox."""

    @property
    def way(self) -> object:
        """A capsule by which C of another room receives and transmits (design/core/frames.h)."""

    def take_port(self, port: Port, /) -> None:
        """Send by ``port`` from now on."""

    def put_before(self, judge: FrameJudge, way_out: int, /) -> None:
        """Let ``judge`` decide about every frame; ``way_out``: the way of the frames sent here, 0 or 1."""

    def receive(self, until: Instant, /) -> tuple[WireFrame, Instant, bool] | None:
        """The next frame, its instant, and whether it is an own one; None if there is none up to ``until``.

        Time passes no further than to that frame, or to ``until``.
        """

    def transmit(self, frame: WireFrame, /) -> None:
        """Queue ``frame`` now, or let its fate befall it. Raises as :meth:`Port.send`."""

    def on_frame(self, frame: WireFrame, now: Instant, /) -> None:
        """Another port's frame ended at ``now``."""

    def on_sent(self, frame: WireFrame, now: Instant, /) -> None:
        """An own frame ended at ``now``: it meets no fault."""

class HubEndOwner(Protocol):
    """Told what is rare at a client's end of a hub; what it raises comes out of the call that let it be."""

    def note(self, packet: bytes, /) -> None:
        """Take a packet that is no frame."""

    def failed(self, error: int, /) -> NoReturn:
        """Raise: the system refused to receive or to send. 0: the other end is closed, or this one."""

    def check_state(self) -> None:
        """Called after each frame sent while ``bus_off``."""

class HubEnd:
    """A client's end of its connection to a hub, a non-blocking socket that keeps packets apart; see
    hub_end_type.c. It is closed by who opened it, and told of that by :meth:`close`.

    While one thread waits, others may call all but :meth:`receive`.
    """

    def __init__(self, descriptor: int, owner: HubEndOwner, /) -> None: ...
    accepts: Callable[[WireFrame], bool] | None
    """Acceptance filter."""
    bus_off: bool
    """The controller was last told to be bus-off."""
    @property
    def way(self) -> object:
        """A capsule by which C of another room receives and transmits (design/core/frames.h)."""

    def receive(self, until: Instant, /) -> tuple[WireFrame, Instant, bool] | None:
        """The next frame, its instant, and whether it is an own one; None at ``until`` (CLOCK_MONOTONIC)."""

    def transmit(self, frame: WireFrame, /) -> None:
        """Hand ``frame`` to the hub, without waiting."""

    def take_in(self, until: Instant, /) -> None:
        """Wait for packets, at most until ``until``, and take in what is there: frames are kept."""

    def close(self) -> None:
        """The socket is closed."""
