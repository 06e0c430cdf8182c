"""The state in which a commissioning leaves its drive: at rest, disabled and as found, or the exceptions; and
the objects that it wrote, each by name, in decimal and with its unit.
"""

from dataclasses import dataclass
from typing import Any, Final

from servobench.hil.commissioning.findings import Findings
from servobench.hil.commissioning.request import CommissionRequest
from servobench.hil.restoring.restore import Restoration
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.object_value import ObjectValue


@dataclass(slots=True)
class DriveLeft:
    """The host's last view of the drive."""

    enabled: bool = False
    """True if it was set up, and may have been enabled in some step."""
    at_rest: bool | None = None
    """None: unknown."""
    disabled: bool | None = None
    """True if the power stage carries no torque; None: unknown."""
    evidence: str = ""
    """Why it is unknown, or not so."""
    host_watched: bool = False
    """True if it stops by itself when it loses the host."""
    changed: int = 0
    """Objects written with another value than they held."""
    restoration: Restoration | None = None
    """None: nothing was restored."""
    kept: tuple[str, ...] = ()
    """Objects that hold what was found, beside those that were restored."""
    stored: bool = False
    not_stored: str = ""
    """Why the drive did not store, if requested."""

    @property
    def as_found(self) -> bool:
        """True if all settings hold their former values."""
        return not self.changed if self.restoration is None else self.restoration.complete

    @property
    def settings(self) -> str:
        """One word for programs: unchanged, restored, kept, stored or changed."""
        if self.stored:
            return "stored"
        if not self.as_found or self.not_stored:
            return "changed"
        if self.kept:
            return "kept"
        return "unchanged" if self.restoration is None else "restored"

    def sentences(self, request: CommissionRequest) -> list[str]:
        """Return sentences for terminal and report: the shaft, then the settings."""
        return [*self._motion(request), self._settings(request)]

    def as_json(self, request: CommissionRequest) -> dict[str, Any]:
        """Return the same for programs; ``mend`` is the command that undoes the changes, or None."""
        changed = self.settings in ("changed", "kept")
        return {
            "at_rest": self.at_rest,
            "disabled": self.disabled,
            "settings": self.settings,
            "mend": request.restore_command if changed else None,
            "text": self.sentences(request),
        }

    def _motion(self, request: CommissionRequest) -> list[str]:
        if self.at_rest and self.disabled:
            return ["The drive is at rest and disabled."]
        if not self.enabled:
            return ["The drive was never enabled."]
        seen = "The drive is at rest, but not confirmed disabled" if self.at_rest else (
            "The drive is NOT confirmed at rest"
        )  # fmt: skip
        cure = (
            f"it was set to stop by itself {request.heartbeat_timeout_ms} ms after the host's last heartbeat"
            if self.host_watched
            else "it does not watch its host: stop it by its own emergency stop"
        )
        return [f"{seen}: {self.evidence or 'it was not asked'}; {cure}."]

    def _settings(self, request: CommissionRequest) -> str:
        if self.not_stored:
            return (
                f"The settings were NOT stored in the drive: {self.not_stored}. It keeps them until it is "
                f"switched off; `{request.restore_command}` puts back what was there before."
            )
        if self.stored:
            return (
                "The settings were stored in the drive (1010h); the journal still holds what was there "
                "before."
            )
        if self.restoration is None:
            if not self.changed:
                return "Nothing was changed."
            objects = f"{self.changed} object{'' if self.changed == 1 else 's'}"
            return f"{objects} may hold other values than before: `{request.restore_command}` puts them back."
        if self.restoration.complete and self.kept:
            return (
                f"What was found stays in {', '.join(self.kept)} until the drive is switched off, all else "
                f"holds what it held before; `{request.restore_command}` puts that back too."
            )
        if self.restoration.complete:
            return (
                f"All {self.restoration.objects} objects that were written hold again, byte for byte, what "
                "they held before; each was read back."
            )
        failures = "; ".join(self.restoration.failures)
        return f"Not all is as it was: {failures}. `{request.restore_command}` tries again."


def changed_objects(findings: Findings) -> list[dict[str, Any]]:
    """In the order of the objects: what each held and what it holds, as bytes, and in words.

    Names, types and units are those of the standard and of what the drive told of itself.
    """
    objects = NodeObjects()
    for (index, sub), value in findings.dump.items():
        objects.take(index, sub, value)
    changes = []
    for key, value in sorted(findings.settings.items(), key=lambda item: str(item[0])):
        before = findings.originals.get(key, b"")
        held, holds = (objects.value(key.index, key.sub, each) for each in (before, value))
        changes.append(
            {
                "object": str(key),
                "name": holds.name,
                "before": before.hex(),
                "set": value.hex(),
                "before_told": held.shown if before else "",
                "set_told": holds.shown,
                "before_decimal": _decimal(held, before),
                "set_decimal": _decimal(holds, value),
            }
        )
    return changes


_TICKS: Final = {
    (0x1006, 0): "us",
    (0x100C, 0): "ms",
    (0x1017, 0): "ms",
    **{(base + number, 3): "x 100 us" for base in (0x1400, 0x1800) for number in range(8)},
    **{(base + number, 5): "ms" for base in (0x1400, 0x1800) for number in range(8)},
}
"""Units of times that CiA 301 fixes."""


def _decimal(value: ObjectValue, data: bytes) -> str:
    """The number in decimal with its unit; SI first where it is known. Identifiers have their hexadecimal
    form behind it."""
    if not data:
        return "not read"
    if not isinstance(value.raw, int):
        return value.shown
    unit = _TICKS.get((value.index, value.sub), "")
    text = f"{value.raw} {unit}".rstrip()
    if value.si is not None:
        text = f"{value.si:.6g} {value.unit} ({value.raw})"
    return f"{text} ({value.raw:X}h)" if value.hexadecimal and value.raw > 9 else text
