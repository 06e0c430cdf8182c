"""Surroundings of the simulated shaft: limit switches, home switch, index pulse, and the STO input.

    2110h:1   inputs held active, bits as in 60FDh, beside what the switches say
    2110h:2   switches fitted: bit 0 negative limit, bit 1 positive limit, bit 2 home
    2110h:3   negative limit switch, active at this encoder count and below
    2110h:4   positive limit switch, active at this encoder count and above
    2110h:5,6 home switch, active from the first count to the second
    2110h:7   index pulse, encoder count within each turn
    2110h:8   safe torque off: 1 takes the torque away
    2110h:9   end stops: how often one was hit, where the motor file has them
    2110h:10  speed at the last hit, mrad/s
    2110h:11  touch probe inputs, bits 0 and 1

Encoder counts are those since power-on, whatever the units and the home of the drive are. Fitted at first are
the switches of the motor file. All of it belongs to the machine: a reset of the node leaves it as it is.
A contact that bounces, or an input with a filter, is watched by the core, at the load's own angle.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from servobench.design.mechanism import Coupling, Mechanism, Side, Switches
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import INTERLOCK, Object
from servobench.virtual_bus.core.native import InnerLoops, clipped
from servobench.virtual_bus.device.object_dictionary import (
    Access,
    DictionaryObject,
    ObjectDictionary,
    Variable,
)
from servobench.virtual_bus.drive.homing_methods import Sensor, SwitchEdge
from servobench.virtual_bus.drive.touch_probe import TouchProbes
from servobench.virtual_bus.drive.user_units import UserUnits

MACHINE: Final = 0x2110
"""Manufacturer-specific."""
ADDITIONAL_VELOCITY: Final = 0x60E5
"""CiA 402-2; sub-index 1 of this and the next: of a second encoder, as of 60E4h."""
ADDITIONAL_FACTORS: Final = {
    0x60E6: (Object.POSITION_ENCODER_RESOLUTION, 1, "Additional position encoder resolution, increments"),
    0x60EB: (Object.POSITION_ENCODER_RESOLUTION, 2, "Additional position encoder resolution, revolutions"),
    0x60E8: (Object.GEAR_RATIO, 1, "Additional gear ratio, motor revolutions"),
    0x60ED: (Object.GEAR_RATIO, 2, "Additional gear ratio, shaft revolutions"),
    0x60E9: (Object.FEED_CONSTANT, 1, "Additional feed constant, feed"),
    0x60EE: (Object.FEED_CONSTANT, 2, "Additional feed constant, shaft revolutions"),
}
"""By which 60E4h is scaled, and of the first encoder's factors the one that it equals."""
_SWITCH_BITS: Final = 0x7
_LIMIT_BITS: Final = 0x3
_FAR: Final = 0x7FFF_FFFF
"""The last count of an INTEGER32: a switch there, and one at its negative, is passed by no axis."""


def _held(variable: Variable) -> int:
    return int(variable.value)


class SimulatedMachine:
    """Switches and inputs, by encoder count."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        counts_per_revolution: int,
        inner: InnerLoops,
        mechanism: Mechanism | None,
        units: UserUnits,
    ) -> None:
        """``inner``: tells where the encoder stands; ``mechanism``: that of the motor, with its switches;
        ``units``: those of captured positions."""
        self.held = 0
        self.fitted = 0
        self.sto = False
        self.inputs = dictionary.add(
            Object.DIGITAL_INPUTS, "Digital inputs", DataType.UNSIGNED32, Access.READ_ONLY, mappable=True
        )
        self._inner = inner
        self._watched = inner.switches != 0
        self._swapped = False
        self._counts = counts_per_revolution
        self._places: list[int] = [-_FAR, _FAR, 0, 0, 0]
        if mechanism is not None and mechanism.switches is not None:
            self._swapped = mechanism.switches.swapped
            self._fit_switches(mechanism.switches)
        self.changed: Callable[[], None] = lambda: None
        """Called after every write of an input or a switch."""
        self.inputs.provider = self.input_bits
        record = self._add_objects(dictionary, inner.end_stops != 0)
        TouchProbes(dictionary, record, inner, units, self.next_index)
        coupling = None if mechanism is None else mechanism.coupling
        if coupling is not None and coupling.second_encoder:
            self._add_second_encoder(dictionary, coupling, units)

    # ---- what the drive sees --------------------------------------------------------------------------

    def input_bits(self) -> int:
        """60FDh."""
        bits = self.held | (INTERLOCK if self.sto else 0)
        for sensor in Sensor:
            if self.active(sensor):
                bits |= 1 << sensor.value
        return bits

    def active(self, sensor: Sensor) -> bool:
        """Return True if a switch is active at the encoder's position."""
        if self.held & 1 << sensor.value:
            return True
        if not self.fitted & 1 << self._switch_at(sensor).value:
            return False
        if self._watched:
            return self._inner.switch_seen(sensor.value)
        low, high = self._stretch(sensor)
        return low <= self._inner.count < high

    @property
    def has_limits(self) -> bool:
        """True if a limit switch is fitted, or held active."""
        return (self.fitted | self.held) & _LIMIT_BITS != 0

    def blocked(self, direction: float) -> bool:
        """Return True if the limit switch at that end of the axis is active."""
        return self.active(Sensor.POSITIVE_LIMIT if direction > 0.0 else Sensor.NEGATIVE_LIMIT)

    def edge_between(self, sensor: Sensor, edge: SwitchEdge, before: float, after: float) -> float:
        """The count of ``edge`` if the encoder has just passed it between the two counts, as captured; else
        ``after``, where an input that is held by hand was noticed."""
        low, high = self._stretch(sensor)
        place = low if edge is SwitchEdge.LEFT else high
        return place if min(before, after) <= place <= max(before, after) else after

    def next_index(self, count: float, direction: int) -> float:
        """The count of the first index pulse beyond ``count``."""
        turns = (count - self._places[4]) / self._counts
        turn = math.floor(turns) + 1 if direction > 0 else math.ceil(turns) - 1
        return float(self._places[4] + turn * self._counts)

    def _switch_at(self, sensor: Sensor) -> Sensor:
        """The switch that is wired to an input."""
        if not self._swapped or sensor is Sensor.HOME:
            return sensor
        return Sensor.NEGATIVE_LIMIT if sensor is Sensor.POSITIVE_LIMIT else Sensor.POSITIVE_LIMIT

    def _stretch(self, sensor: Sensor) -> tuple[float, float]:
        """Where an input is active."""
        negative, positive, home_from, home_to, _ = self._places
        switch = self._switch_at(sensor)
        if switch is Sensor.NEGATIVE_LIMIT:
            return -math.inf, negative + 1.0
        if switch is Sensor.POSITIVE_LIMIT:
            return float(positive), math.inf
        return float(home_from), home_to + 1.0

    def _fit_switches(self, switches: Switches) -> None:
        ends = switches.negative_turns, switches.positive_turns, *(switches.home_turns or (None, None))
        for place, turns in enumerate(ends):
            if turns is not None:
                self.fitted |= 1 << min(place, Sensor.HOME.value)
                self._places[place] = clipped(turns * self._counts, 32)
        self._place_switches()

    def _place_switches(self) -> None:
        """For the core, which watches them at the load's own angle."""
        for sensor in Sensor:
            low, high = self._stretch(sensor)
            self._inner.set_switch(sensor.value, low / self._counts, high / self._counts)

    # ---- objects --------------------------------------------------------------------------------------

    def _add_objects(self, dictionary: ObjectDictionary, stops: bool) -> DictionaryObject:
        record = dictionary.add_record(MACHINE, "Simulated machine")

        def add(
            sub: int, name: str, data_type: DataType, high: int | None, read: Callable[[], Any], write: Any
        ) -> None:
            record.add(
                sub,
                name,
                data_type,
                mappable=True,
                low=None if data_type is DataType.INTEGER32 else 0,
                high=high,
                stored=False,
                on_write=write,
                provider=read,
            )

        add(1, "Inputs held active", DataType.UNSIGNED32, None, lambda: self.held, self._hold)
        add(2, "Switches fitted", DataType.UNSIGNED8, _SWITCH_BITS, lambda: self.fitted, self._fit)
        for place, name in enumerate(
            ("Negative limit switch", "Positive limit switch", "Home switch from", "Home switch to")
        ):
            add(3 + place, name, DataType.INTEGER32, None, self._reader(place), self._writer(place))
        add(7, "Index pulse", DataType.UNSIGNED32, self._counts - 1, self._reader(4), self._writer(4))
        add(8, "Safe torque off", DataType.UNSIGNED8, 1, lambda: int(self.sto), self.switch_sto)
        if stops:
            tells = partial(record.add, access=Access.READ_ONLY, mappable=True, stored=False)
            tells(9, "End stops hit", DataType.UNSIGNED32, provider=lambda: int(self._inner.stop_hits))
            tells(10, "Speed at the last hit", DataType.INTEGER32, provider=self._hit_speed)
        return record

    def _add_second_encoder(self, dictionary: ObjectDictionary, coupling: Coupling, units: UserUnits) -> None:
        """60E4h to 60EEh: the encoder on the other side of the coupling, with as many counts, the factors of
        the first, and no errors."""
        inner, on_load = self._inner, coupling.encoder is Side.MOTOR

        def position() -> int:
            ahead_rad = inner.angle_rad - (inner.twist_rad if on_load else 0.0)
            return units.position_of(math.floor((inner.turns + ahead_rad / math.tau) * self._counts))

        def velocity() -> int:
            speed_rad_s = inner.load_speed_rad_s if on_load else inner.speed_rad_s
            return clipped(speed_rad_s * units.velocity_per_rad_s, 32)

        read_only, i32 = Access.READ_ONLY, DataType.INTEGER32
        told = dictionary.add_array(Object.ADDITIONAL_POSITION, "Additional position")
        told.add(1, "Second encoder", i32, read_only, mappable=True, provider=position)
        told = dictionary.add_array(ADDITIONAL_VELOCITY, "Additional velocity")
        told.add(1, "Second encoder", i32, read_only, mappable=True, provider=velocity)
        for index, (first, sub, name) in ADDITIONAL_FACTORS.items():
            factor = partial(_held, dictionary.variable(first, sub))
            told = dictionary.add_array(index, name)
            told.add(1, "Second encoder", DataType.UNSIGNED32, read_only, stored=False, provider=factor)

    def _hit_speed(self) -> int:
        """mrad/s."""
        return clipped(1000.0 * self._inner.stop_hit_rad_s, 32)

    def _reader(self, place: int) -> Callable[[], int]:
        return lambda: self._places[place]

    def _writer(self, place: int) -> Callable[[int], None]:
        def write(count: int) -> None:
            self._places[place] = count
            self._place_switches()
            self.changed()

        return write

    def _hold(self, bits: int) -> None:
        self.held = bits
        self.changed()

    def _fit(self, bits: int) -> None:
        self.fitted = bits
        self.changed()

    def switch_sto(self, value: int) -> None:
        """Safe torque off: 1 open, 0 closed."""
        self.sto = value != 0
        self.changed()
