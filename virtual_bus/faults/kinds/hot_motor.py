"""``[[hot_motor]]``: winding and magnets of a motor are hot for a while."""

from typing import Annotated, Final

from servobench.design.data_sheet import at_temperature
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns, within
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

_COLD_C: Final = 20.0
"""At which the motor's file has its resistance and flux; a ``[temperature]`` of that file counts besides."""
_MAGNET_PER_K: Final = -0.0012
"""Change of the flux of sintered neodymium by a kelvin."""
_MILLI: Final = 1000
Celsius = Annotated[float, within(-40.0, 250.0, "-40 to 250 degrees C")]


class HotMotor(NodeOccasion):
    """The copper has more resistance, the magnets less flux, and the drive reckons with neither."""

    kind = "hot_motor"
    logs = (
        node_event(
            "hot_motor",
            LogNumber("duration_ns"),
            LogNumber("winding_mc", least=-40 * _MILLI),
            LogNumber("magnet_mc", least=-40 * _MILLI),
        ),
    )
    needs_drive = True
    strikes_plant = True
    winding_c: Celsius
    magnet_c: Celsius
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return ns(self.duration_s), round(_MILLI * self.winding_c), round(_MILLI * self.magnet_c)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        winding_c, magnet_c = event.b / _MILLI, event.c / _MILLI
        resistance = at_temperature(1.0, _COLD_C, winding_c)
        flux = 1.0 + _MAGNET_PER_K * (magnet_c - _COLD_C)
        node.damage(lambda drive: drive.heat_motor(resistance, flux, winding_c), now)
        node.later(now + event.a, lambda at: node.damage(lambda drive: drive.heat_motor(1.0, 1.0), at))

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        hot = f"winding at {event.b / _MILLI:g} and magnets at {event.c / _MILLI:g} degrees C"
        return f"{hot} for {event.a / NS_PER_MS:g} ms, {node}"
