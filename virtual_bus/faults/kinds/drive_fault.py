"""``[[drive_fault]]``: a drive that finds an error of its own."""

from collections.abc import Mapping
from enum import Enum
from typing import Any, Literal

from pydantic import model_validator

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import LogNumber, Number, Seconds, node_event, ns, require
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode


class DriveFailure(Enum):
    """A fault of the drive: error code 603Fh (CiA 402-2, 6.2.3, and CiA 301, table 26) and bits of 1001h."""

    OVER_CURRENT = (0x2310, ErrorRegister.CURRENT)
    OVER_TEMPERATURE = (0x4310, ErrorRegister.TEMPERATURE)
    FOLLOWING_ERROR = (0x8611, ErrorRegister.DEVICE_PROFILE)
    ENCODER_LOSS = (0x7305, ErrorRegister.DEVICE_PROFILE)
    UNDER_VOLTAGE = (0x3220, ErrorRegister.VOLTAGE)

    @property
    def label(self) -> str:
        """Name in a plan: ``over_current``."""
        return self.name.lower()

    @property
    def code(self) -> int:
        """Error code 603Fh."""
        return self.value[0]

    @property
    def register(self) -> ErrorRegister:
        """Bits of 1001h."""
        return ErrorRegister(self.value[1] | ErrorRegister.GENERIC)


FAILURES = list(DriveFailure)
"""By the number that stands for each in the log."""
_ENCODER_LOSS = DriveFailure.ENCODER_LOSS.label


class DriveFault(NodeOccasion):
    """The drive fails: EMCY, 603Fh, fault reaction of 605Eh.

    A lost encoder stands still at its last count for ``duration_s``; noticed after ``detected_after_ms``.
    """

    kind = "drive_fault"
    logs = (
        node_event(
            "drive_fault",
            LogNumber("fault", words=tuple(failure.label for failure in FAILURES)),
            LogNumber("detected_after_ns"),
            LogNumber("duration_ns"),
        ),
    )
    needs_drive = True
    strikes_plant = True
    fault: Literal["over_current", "over_temperature", "following_error", "encoder_loss", "under_voltage"]
    detected_after_ms: Number = 0.0
    """For an encoder; default 2."""
    duration_s: Seconds = 0.0
    """For an encoder; default 0.1."""

    @model_validator(mode="before")
    @classmethod
    def _encoder(cls, table: Mapping[str, Any]) -> Mapping[str, Any]:
        lost = table.get("fault") == _ENCODER_LOSS
        return {"detected_after_ms": 2.0, "duration_s": 0.1, **table} if lost else table

    @model_validator(mode="after")
    def _check_encoder(self) -> "DriveFault":
        lost, after = self.fault == _ENCODER_LOSS, self.detected_after_ms
        only = 'nothing unless fault = "encoder_loss"'
        require(lost or after == 0, "detected_after_ms", after, only)
        require(lost or self.duration_s == 0, "duration_s", self.duration_s, only)
        require(0 <= after <= 10_000, "detected_after_ms", after, "0 to 10000 ms")
        least = ns(self.duration_s) >= self.detected_after_ns
        require(least, "duration_s", self.duration_s, f"at least detected_after_ms = {after:g}")
        return self

    @property
    def failure(self) -> DriveFailure:
        """``fault``."""
        return DriveFailure[self.fault.upper()]

    @property
    def detected_after_ns(self) -> int:
        """``detected_after_ms``."""
        return ns(self.detected_after_ms, "ms")

    @property
    def stream_name(self) -> str:
        """Each failure counts for itself: one more over-current shifts no under-voltage."""
        return f"{self.kind} {self.fault}"

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return FAILURES.index(self.failure), self.detected_after_ns, ns(self.duration_s)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        failure = FAILURES[event.a]

        def fail(at: Instant) -> None:
            node.fail(failure.code, failure.register, at)

        if failure is not DriveFailure.ENCODER_LOSS:
            fail(now)
            return
        node.hold_encoder(True, now)
        node.later(now + event.b, fail)
        node.later(now + event.c, lambda at: node.hold_encoder(False, at))

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:
        return event.c

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        lasts = f" for {event.c / NS_PER_MS:g} ms" if event.c else ""
        return f"drive fault {FAILURES[event.a].label.replace('_', ' ')}, {node}{lasts}"
