"""HM, homing mode (CiA 402-2): the methods of :mod:`servobench.virtual_bus.drive.homing_methods`, carried
out.

    SEARCH   at 6099h:1 until the edge of the switch is passed, in whatever direction
    RETURN   at 6099h:2 back over the edge, where it was passed in the direction of the last crossing
    CREEP    at 6099h:2 over the edge in that direction: its encoder count is captured
    PULSE    on to the next index pulse, where the method has one

All ramps are 609Ah. The home is where the capture was; the shaft stops behind it. The zero of positions is
the home plus 607Ch, so that the position of the home is minus 607Ch. "Positive" is the encoder's direction.

    bits 13 12 10   0 0 0 under way     0 0 1 not started, or interrupted     0 1 0 found, stopping
                    0 1 1 done          1 0 0 failed, stopping                1 0 1 failed
"""

from enum import Enum
from typing import Final

from servobench.drivers.cia402.profile import Control, Status
from servobench.virtual_bus.drive.axis import SimulatedAxis
from servobench.virtual_bus.drive.homing_methods import (
    HOMING_METHODS,
    TURNS_AT_LIMIT,
    HomingMethod,
    Sensor,
    SwitchEdge,
)
from servobench.virtual_bus.drive.operation_mode import HaltedMode

START: Final = Control.MODE_4
TRAVEL_TURNS_MAX: Final = 1000
"""A search that has come so far fails: a motor of 3000 rpm needs over three minutes for it at the default of
6099h:1, a tenth of its speed."""


class HomingPhase(Enum):
    """How far a homing is."""

    IDLE = "idle"
    SEARCH = "search"
    RETURN = "return"
    CREEP = "creep"
    PULSE = "pulse"
    FOUND = "found"
    FAILED = "failed"


_UNDER_WAY: Final = (HomingPhase.SEARCH, HomingPhase.RETURN, HomingPhase.CREEP, HomingPhase.PULSE)


class Homing(HaltedMode):
    """One homing at a time, begun by the rising edge of bit 4 and interrupted by its fall."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._word = 0
        self._number = 35
        self._method: HomingMethod = HOMING_METHODS[35]
        self._step = HomingPhase.IDLE
        self._direction = 0
        self._active = False
        self._count = 0.0
        self._travelled = 0.0
        self._pulse_at = 0.0
        self._turned = False

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._word = controlword
        self._stop(HomingPhase.IDLE)
        self.begin_halt(controlword)

    def receive(self, controlword: int) -> None:
        changed = controlword ^ self._word
        self._word = controlword
        if changed & START:
            if controlword & START:
                self._start()
            elif self._step in _UNDER_WAY:
                self._stop(HomingPhase.IDLE)
        if self.take_halt(controlword) and self._step in _UNDER_WAY:
            self._go(self._direction)

    def run(self) -> None:
        if self._step not in _UNDER_WAY or self.halted:
            return
        before, self._count = self._count, self.axis.count
        self._travelled += abs(self._count - before)
        if self._travelled > TRAVEL_TURNS_MAX * self.axis.firmware.parameters.encoder_counts_per_revolution:
            self._stop(HomingPhase.FAILED)
        elif self._step is HomingPhase.PULSE:
            self._look_for_pulse()
        else:
            self._look_for_edge(before)

    def status_bits(self) -> int:
        if self._step in _UNDER_WAY:
            return self.target_bit(False)
        bits = Status.TARGET_REACHED if self.axis.rests() else 0
        if self._step is HomingPhase.FOUND:
            bits |= Status.MODE_12
        elif self._step is HomingPhase.FAILED:
            bits |= Status.MODE_13
        return bits

    def slow_down_rad_s2(self) -> float:
        return self.axis.homing_rad_s2

    # ---- inside ---------------------------------------------------------------------------------------

    def _start(self) -> None:
        axis = self.axis
        self._number = axis.motion.homing_method.value
        self._method = method = HOMING_METHODS[self._number]
        self._count, self._travelled, self._turned = axis.count, 0.0, False
        if method.sensor is not None:
            self._active = axis.machine.active(method.sensor)
            self._begin(HomingPhase.SEARCH, method.start_active if self._active else method.start_inactive)
        elif method.pulse:
            self._pulse_from(self._count)
        else:
            self._found(self._count)

    def _begin(self, step: HomingPhase, direction: int) -> None:
        self._step = step
        self._go(direction)

    def _go(self, direction: int) -> None:
        axis, motion = self.axis, self.axis.motion
        self._direction = direction
        velocity = motion.switch_speed if self._step is HomingPhase.SEARCH else motion.zero_speed
        if not self.halted:
            speed = axis.cut_speed(axis.speed_of(velocity.value))
            axis.firmware.ramp_to_speed(direction * speed, axis.homing_rad_s2)

    def _look_for_edge(self, before: float) -> None:
        sensor = self._method.sensor
        assert sensor is not None, "methods without a switch look for a pulse"
        was, self._active = self._active, self.axis.machine.active(sensor)
        if self._active == was:
            self._watch_limit(sensor)
            return
        moving = 1 if self._count > before or (self._count == before and self._direction > 0) else -1
        edge = SwitchEdge.LEFT if self._active == (moving > 0) else SwitchEdge.RIGHT
        if edge is self._method.edge:
            self._passed_edge(sensor, moving, before)
        elif self._active:
            self._go(1 if self._method.edge is SwitchEdge.RIGHT else -1)
        else:
            self._go(-moving)

    def _passed_edge(self, sensor: Sensor, moving: int, before: float) -> None:
        across = self._method.across
        if moving != across:
            self._begin(HomingPhase.CREEP, across)
        elif self._step is not HomingPhase.CREEP:
            self._begin(HomingPhase.RETURN, -across)
        else:
            place = self.axis.machine.edge_between(sensor, self._method.edge, before, self._count)
            if self._method.pulse:
                self._pulse_from(place)
            else:
                self._found(place)

    def _watch_limit(self, sensor: Sensor) -> None:
        """The end of the axis on the way: turn round once if the method does, else that was it."""
        ahead = Sensor.POSITIVE_LIMIT if self._direction > 0 else Sensor.NEGATIVE_LIMIT
        if ahead is sensor or not self.axis.machine.active(ahead):
            return
        if self._number in TURNS_AT_LIMIT and self._step is HomingPhase.SEARCH and not self._turned:
            self._turned = True
            self._go(-self._direction)
        else:
            self._stop(HomingPhase.FAILED)

    def _pulse_from(self, count: float) -> None:
        across = self._method.across
        self._pulse_at = self.axis.machine.next_index(count, across)
        self._begin(HomingPhase.PULSE, across)

    def _look_for_pulse(self) -> None:
        if (self._count - self._pulse_at) * self._method.across >= 0.0:
            self._found(self._pulse_at)
        elif self.axis.machine.blocked(self._direction):
            self._stop(HomingPhase.FAILED)

    def _found(self, count: float) -> None:
        axis = self.axis
        axis.units.set_origin(count + axis.motion.home_offset.value * axis.units.counts_per_position)
        self._stop(HomingPhase.FOUND)

    def _stop(self, step: HomingPhase) -> None:
        self._step = step
        self.axis.stop(self.slow_down_rad_s2())
