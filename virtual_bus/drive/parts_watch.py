"""What changes inside a simulated drive and its machine, for a recording: no bus tells it.

The drive looks at itself where it tells its cyclic values, at each SYNC and at least every 20 ms; the instant
told is that of its last inner tick.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.drive.homing_methods import Sensor
from servobench.virtual_bus.drive.power_stage import Overload, Supply

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import ServoApplication


class PartChange(NamedTuple):
    """From an instant on one part is in another state."""

    at: Instant
    part: str
    """"current", "supply", "brake", "stops" or "switches"."""
    state: str
    """Empty: as usual."""
    text: str
    """Worth reading; empty: not so."""
    limits: bool
    """The drive or its machine does not do what it is asked for."""


class WatchedPart(NamedTuple):
    """Something that can be in another state than usual."""

    name: str
    state: Callable[[], str]
    says: Callable[[str], str]
    """Of a new state, in words."""
    limits: bool = True


class PartsWatch:
    """Tells of the changes of one drive."""

    def __init__(self, drive: "ServoApplication", tell: Callable[[PartChange], None]) -> None:
        self._inner = drive.firmware.inner
        self._tell = tell
        self._parts = list(_parts(drive))
        self._states = [""] * len(self._parts)
        if self._parts and drive.cycle is not None:
            drive.look = self.look
            drive.cycle.protects = True

    def look(self) -> None:
        """Tell what is otherwise than at the last look."""
        for place, part in enumerate(self._parts):
            state = part.state()
            if state != self._states[place]:
                self._states[place] = state
                at = Instant(self._inner.tick_at())
                self._tell(PartChange(at, part.name, state, part.says(state), part.limits and state != ""))


def _parts(drive: "ServoApplication") -> Iterator[WatchedPart]:
    inner, parameters, machine = drive.firmware.inner, drive.firmware.parameters, drive.firmware.machine
    protection, supply = parameters.protection, parameters.supply
    if protection is not None and (protection.overload is not None or protection.stage is not None):
        overload = protection.overload
        yield WatchedPart(
            "current", lambda: _current(inner), lambda state: _of_current(inner, state, overload)
        )
    if supply is not None:
        yield WatchedPart("supply", lambda: _supply(inner, supply), lambda state: _of_supply(inner, state))
    if parameters.brake_output:
        yield WatchedPart("brake", lambda: _brake(inner), lambda _state: "", limits=False)
    mechanism = machine.mechanism
    if mechanism is not None and mechanism.load is not None and mechanism.load.stops is not None:
        yield WatchedPart("stops", _stops(inner), lambda state: _of_stops(inner, state))
    if mechanism is not None and mechanism.switches is not None:
        yield WatchedPart("switches", lambda: _switches(drive), lambda _state: "", limits=False)


_LIMITED, _WARNED, _DERATED = "Limited", "Warned", "Derated"
_CHOPPED, _CHARGED, _LOW = "Braking resistor", "Charged", "Low"
_CHARGED_FROM, _LOW_BELOW = 1.02, 0.9
"""Of the source's voltage without load: what braking returns, and more than source and cable lose."""


def _current(inner: InnerLoops) -> str:
    return _LIMITED if inner.limiting else _DERATED if inner.derated else _WARNED if inner.warning else ""


def _of_current(inner: InnerLoops, state: str, overload: Overload | None) -> str:
    if state == _DERATED:
        return f"power stage at {inner.stage_c:.0f} degrees C: its largest current falls"
    if overload is None:
        return "power stage has cooled: the current is free"
    if state == _LIMITED:
        then = (
            "the drive fails" if overload.trips else f"current limited to {overload.continuous_a_rms:g} A rms"
        )
        return f"I^2 t is full: {then}"
    if state == _WARNED:
        return f"I^2 t is above {overload.warning_percent:g} % of its limit"
    return "I^2 t has fallen: the current is free"


def _supply(inner: InnerLoops, supply: Supply) -> str:
    if inner.chopping and supply.chopper is not None:
        return _CHOPPED
    share = inner.link_v / supply.voltage_v
    return _CHARGED if share > _CHARGED_FROM else _LOW if share < _LOW_BELOW else ""


def _of_supply(inner: InnerLoops, state: str) -> str:
    return f"DC link at {inner.link_v:.3g} V" if state == _LOW else ""


def _brake(inner: InnerLoops) -> str:
    if inner.brake_holds:
        return "Holds" if inner.braked else "Opening"
    return "Closing" if inner.braked else ""


def _stops(inner: InnerLoops) -> Callable[[], str]:
    """A hit that is over before the next look is told too."""
    seen = 0

    def state() -> str:
        nonlocal seen
        hits = int(inner.stop_hits)
        if not inner.stop_touched and hits == seen:
            return ""
        seen = hits
        return f"Hit {hits}"

    return state


def _of_stops(inner: InnerLoops, state: str) -> str:
    return f"end stop hit at {abs(inner.stop_hit_rad_s):.3g} rad/s" if state else ""


def _switches(drive: "ServoApplication") -> str:
    made = (sensor.name.lower().replace("_", " ") for sensor in Sensor if drive.machine.active(sensor))
    return ", ".join(made).capitalize()
