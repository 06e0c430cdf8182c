"""The gains of a simulated drive's own loops as objects, where ``gain_objects`` asks for them.

    2121h:1   current loop, q axis: P, V/A        2121h:4   speed loop: P, N m s/rad
    2121h:2   current loop, d axis: P, V/A        2121h:5   speed loop: I, N m/rad
    2121h:3   current loop, both axes: I, V/(A s) 2121h:6   position loop: P, 1/s

All REAL32, of the parallel form P + I/s. They act at once, enabled or not: the integrals are kept in volts
and newton metres, so a new gain makes no step of its own.

A drive behind a maker's data sheet has the maker's objects in the place of 2121h, as far as a file in
drivers/vendors names them with unit and structure. A current P without one for the d axis is both axes'. A
position loop is taken where it puts out a speed: the simulated drive has no other. Until one is written, the
loops are those that the drive was made with, to the last digit.
"""

import math
from collections.abc import Callable
from typing import Any, Final

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import Cia301, DataType
from servobench.drivers.vendors.families import gains_for, motor_objects_for
from servobench.drivers.vendors.gain_objects import GainObject, GainObjects, LoopGains
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.axis import SimulatedAxis
from servobench.virtual_bus.drive.firmware import Firmware
from servobench.virtual_bus.drive.power_stage import current_per_rms

LOOP_GAINS: Final = 0x2121
_NAMES: Final = (
    "Current loop P, q axis",
    "Current loop P, d axis",
    "Current loop I",
    "Speed loop P",
    "Speed loop I",
    "Position loop P",
)

Place = tuple[str, str]
"""Loop and gain, by the keys of LOOPS and GAINS."""


def told_gains(dictionary: ObjectDictionary, axis: SimulatedAxis, there: bool) -> Callable[[], None]:
    """Return what a drive does at power-on; its objects are made where they are to be ``there``."""
    return SimulatedGains(dictionary, axis).take if there else lambda: None


class SimulatedGains:
    """Objects that set the loops."""

    def __init__(self, dictionary: ObjectDictionary, axis: SimulatedAxis) -> None:
        self._dictionary, self._axis, self._firmware = dictionary, axis, axis.firmware
        self._made = _made(self._firmware, axis)
        self._held: list[tuple[Variable, LoopGains, str]] | None = None
        record = dictionary.add_record(LOOP_GAINS, "Loop gains")
        for sub, name in enumerate(_NAMES, start=1):
            record.add(sub, name, DataType.REAL32, low=0.0, check=_refused)

    def take(self) -> None:
        """Power-on: the objects of this drive's maker are in force."""
        if self._held is None:
            self._held = self._begin(gains_for(*self._identity()))
        for variable, loop, key in self._held:
            self._act(variable, loop, key)

    def _begin(self, known: GainObjects | None) -> list[tuple[Variable, LoopGains, str]]:
        """Have the objects show the gains that the drive was made with, and act where they are written."""
        held = []
        for loop in () if known is None else known.loops.values():
            for key, each in loop.objects.items():
                variable = self._dictionary.get(each.index, each.sub)
                value = self._shown(loop, key)
                if variable is None or value is None or not variable.writable:
                    continue
                default = _typed(each, value)
                if variable.value == variable.default:
                    variable.value = default
                variable.default = default
                variable.on_write = self._acting(variable, loop, key)
                held.append((variable, loop, key))
        return held

    def _acting(self, variable: Variable, loop: LoopGains, key: str) -> Callable[[Any], None]:
        return lambda _value: self._act(variable, loop, key)

    def _shown(self, loop: LoopGains, key: str) -> float | None:
        """Return the gain that the drive was made with, SI units of its object; None: it has none such."""
        made = self._made.get((loop.loop, key))
        if loop.lack or made is None:
            return None
        factor = self._factor(loop)
        if factor is None:
            return None
        if loop.form == "ideal" and key == "i":
            proportional = self._made[loop.loop, "p"]
            return made / proportional if proportional else None
        return made / factor

    def _act(self, variable: Variable, loop: LoopGains, key: str) -> None:
        """Set the loop as ``variable`` holds it; as it was made where that is the drive's own default."""
        value = self._made[loop.loop, key]
        if variable.value != variable.default:
            given = loop.objects[key].value(float(variable.value)) or 0.0
            value = given * (self._factor(loop) or 0.0)
            if loop.form == "ideal" and key == "i":
                value = given * self._now(loop.loop, "p")
        self._set(loop.loop, key, value)
        if (loop.loop, key) == ("current", "p") and "p_d" not in loop.objects:
            own = variable.value == variable.default
            self._set("current", "p_d", self._made["current", "p_d"] if own else value)
        if loop.form == "ideal" and key == "p" and "i" in loop.objects:
            integral = self._dictionary.get(loop.objects["i"].index, loop.objects["i"].sub)
            if integral is not None:
                self._act(integral, loop, "i")

    def _now(self, loop: str, key: str) -> float:
        inner = self._firmware.inner
        return float(inner.gain_q if (loop, key) == ("current", "p") else inner.speed_gain)

    def _set(self, loop: str, key: str, value: float) -> None:
        inner = self._firmware.inner
        if (loop, key) == ("current", "p"):
            inner.gain_q, inner.per_gain_q = value, 1.0 / value if value else 0.0
        elif (loop, key) == ("current", "p_d"):
            inner.gain_d, inner.per_gain_d = value, 1.0 / value if value else 0.0
        elif (loop, key) == ("current", "i"):
            inner.integral_gain = value * self._firmware.tick_s
        elif (loop, key) == ("speed", "p"):
            inner.speed_gain = value
        elif (loop, key) == ("speed", "i"):
            inner.speed_integral_gain = value
        else:
            self._axis.position_gain = value

    def _factor(self, loop: LoopGains) -> float | None:
        """Return what a gain of the maker's, SI units, is multiplied with to be the simulated loop's."""
        if loop.loop == "position":
            return 1.0 if loop.output == "speed" else None
        return self._torque_constant(loop.ampere) if loop.output == "current" else 1.0

    def _torque_constant(self, ampere: str) -> float:
        """N m per ampere of the maker's."""
        motor: PmsmParameters = self._firmware.motor
        per_rms = motor.torque_constant_nm_a * current_per_rms(motor)
        if ampere == "peak":
            return per_rms / math.sqrt(2.0)
        for _, known in () if ampere == "rms" else motor_objects_for(*self._identity()):
            for each in known.objects:
                variable = self._dictionary.get(each.index, each.sub)
                if each.quantity == "torque_constant_nm_a" and variable is not None and variable.value:
                    return float(variable.value) * each.factor
        return per_rms

    def _identity(self) -> tuple[int, int, str]:
        vendor, product = (self._told(Cia301.IDENTITY, sub) or 0 for sub in (1, 2))
        name = self._told(Cia301.DEVICE_NAME, 0)
        text = name.split(b"\0", 1)[0].decode("latin-1").strip() if isinstance(name, bytes) else ""
        return int(vendor), int(product), text

    def _told(self, index: int, sub: int) -> Any:
        variable = self._dictionary.get(index, sub)
        return None if variable is None else variable.default


def _made(firmware: Firmware, axis: SimulatedAxis) -> dict[Place, float]:
    """Return the gains that the drive was made with, parallel and in SI units, by loop and key."""
    inner, parameters = firmware.inner, firmware.parameters
    made = {
        ("speed", "p"): inner.speed_gain,
        ("speed", "i"): inner.speed_integral_gain,
        ("position", "p"): axis.position_gain,
    }
    if parameters.controller_d is None and parameters.controller_q is None:  # they would take the PI's place
        made["current", "p"], made["current", "p_d"] = inner.gain_q, inner.gain_d
        made["current", "i"] = inner.integral_gain / firmware.tick_s
    return made


def _typed(known: GainObject, value: float) -> int | float:
    """Return the raw value as a dictionary holds it; at least one unit, where 0 would take the gain away."""
    raw = known.nearest(value)
    return raw if known.type == "REAL32" else max(1 if value > 0.0 else 0, int(raw))


def _refused(value: float) -> AbortCode | None:
    return None if math.isfinite(value) else AbortCode.INVALID_VALUE
