"""``[[repeated_emergency]]``: a drive that sends the same EMCY again and again, and stays enabled."""

from typing import Annotated, Final

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import NONE, Lasting, LogNumber, node_event, ns, within
from servobench.virtual_bus.faults.node_fault import EVERY_MIN, Draw, NodeEvent, NodeOccasion, StruckNode

_REGISTERS: Final = {
    2: ErrorRegister.CURRENT,
    3: ErrorRegister.VOLTAGE,
    4: ErrorRegister.TEMPERATURE,
    8: ErrorRegister.COMMUNICATION,
}
"""By the class of the error code, its first digit (CiA 301, table 26); the others belong to the device
profile."""
_EVERY_MIN_MS: Final = EVERY_MIN / NS_PER_MS


class RepeatedEmergency(NodeOccasion):
    """While the drive is enabled it sends an EMCY every ``period_ms``, without a fault: it goes on to follow.
    1001h and 603Fh tell the error too, until the drive is switched off.

    ``duration_s`` left out: for good.
    """

    kind = "repeated_emergency"
    logs = (
        node_event(
            "repeated_emergency",
            LogNumber("code"),
            LogNumber("period_ns"),
            LogNumber("duration_ns", usual=NONE),
        ),
    )
    needs_drive = True
    code: Annotated[int, within(0x1000, 0xFFFF, "an error code from 0x1000 to 0xFFFF (CiA 301, table 26)")]
    period_ms: Annotated[float, within(_EVERY_MIN_MS, 1e6, f"a time from {_EVERY_MIN_MS:g} ms")] = 10.0
    """Ten of a drive's cycles of 1 ms: a list of events is full within a second."""
    duration_s: Lasting | None = None

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        lasts_ns = NONE if self.duration_s is None else ns(self.duration_s)
        return self.code, ns(self.period_ms, "ms"), lasts_ns

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        register = _REGISTERS.get(event.a >> 12, ErrorRegister.DEVICE_PROFILE)

        def report(at: Instant) -> None:
            if event.c == NONE or at < now + event.c:
                node.report_again(event.a, register, at)
                node.later(at + event.b, report)

        report(now)

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:
        return event.c

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        lasts = "" if event.c == NONE else f" for {event.c / NS_PER_MS:g} ms"
        return f"EMCY {event.a:04X}h every {event.b / NS_PER_MS:g} ms, {node}{lasts}"
