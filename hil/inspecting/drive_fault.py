"""The state of a drive, its faults in words, and their reset on the user's word."""

from dataclasses import dataclass
from typing import Any

from servobench.drivers.canopen.error_codes import fault_text, history_text, register_text
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.state_control import FAULTY
from servobench.drivers.timebase import NS_PER_S, Duration

_CONNECT_NS = Duration(2 * NS_PER_S)
"""Somebody waits at the terminal, and a drive that is on answers at once."""
_RESET_NS = Duration(2 * NS_PER_S)
_LISTEN_NS = Duration(NS_PER_S // 10)
_HISTORY_MAX = 16
"""1003h has up to 254 entries, the newest first."""


@dataclass(frozen=True, slots=True)
class DriveDiagnosis:
    """State and faults of a drive, in its own words."""

    node: int
    device: str
    state: str
    in_fault: bool
    error_code: int | None
    error: str
    register: int | None
    """0x1001."""
    history: tuple[tuple[int, str], ...]
    """Entries of 0x1003, the newest first: the whole UNSIGNED32, and its code in words."""
    was_reset: bool = False

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "node": self.node,
            "device": self.device,
            "state": self.state,
            "in_fault": self.in_fault,
            "error_code": None if self.error_code is None else f"0x{self.error_code:04X}",
            "error": self.error,
            "error_register": self.register,
            "history": [{"entry": f"0x{entry:08X}", "error": text} for entry, text in self.history],
            "was_reset": self.was_reset,
        }

    def lines(self) -> list[str]:
        """For the terminal."""
        lines = [f"node {self.node}: {self.device}", f"state: {self.state}"]
        if self.error_code is not None:
            lines.append(f"error code {self.error_code:04X}h: {self.error}")
        if self.register is not None:
            lines.append(f"error register {self.register:02X}h: {register_text(self.register)}")
        lines += [f"before: {entry:08X}h: {text}" for entry, text in self.history]
        return [*lines, "the fault was reset"] if self.was_reset else lines


def look_at_fault(network: CanopenNetwork, node: int, reset: bool) -> DriveDiagnosis:
    """Ask a drive; with ``reset`` reset its fault. Raises NoAnswer, PeerFault, DriveInFault if it stays."""
    drive = ServoDrive(network, node)
    identity = drive.connect(network.deadline_after(_CONNECT_NS))
    network.pump(network.deadline_after(_LISTEN_NS))
    before = _asked(drive, str(identity), was_reset=False)
    if not (reset and before.in_fault):
        return before
    drive.reset_fault(network.deadline_after(_RESET_NS))
    return _asked(drive, str(identity), was_reset=True)


def _asked(drive: ServoDrive, device: str, was_reset: bool) -> DriveDiagnosis:
    objects, make = drive.objects, drive.control.make
    state = drive.control.read_state()
    code = objects.read_if_there(Object.ERROR_CODE, 0, "H")
    history = _history(drive)
    if code is None and history and state in FAULTY:
        code = history[0][0] & 0xFFFF
    return DriveDiagnosis(
        node=drive.node_id,
        device=device,
        state="unknown" if state is None else state.value,
        in_fault=state in FAULTY,
        error_code=code,
        error="" if code is None else fault_text(code, *make),
        register=objects.read_if_there(Cia301.ERROR_REGISTER, 0, "B"),
        history=history,
        was_reset=was_reset,
    )


def _history(drive: ServoDrive) -> tuple[tuple[int, str], ...]:
    objects = drive.objects
    count = objects.read_if_there(Cia301.ERROR_HISTORY, 0, "B") or 0
    entries = [
        objects.read_if_there(Cia301.ERROR_HISTORY, sub) for sub in range(1, min(count, _HISTORY_MAX) + 1)
    ]
    make = drive.control.make
    return tuple((entry, history_text(entry, *make)) for entry in entries if entry)
