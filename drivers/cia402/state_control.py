"""Moves a drive through the state machine of CiA 402-2, with deadlines, and with evidence when it fails."""

from collections import deque
from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.error_codes import fault_text, register_text
from servobench.drivers.canopen.nmt import Emergency, condensed
from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.objects301 import FIRST_OBJECT, Cia301, object_name
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_plans import TARGETS
from servobench.drivers.cia402.profile import (
    CONTROLWORDS,
    DriveCommand,
    Mode,
    State,
    command_path,
    state_of,
)
from servobench.drivers.cia402.setpoint import SetPointFrames
from servobench.drivers.core.native import LastStatusword
from servobench.drivers.errors import DriveInFault, PeerFault, TransferAborted
from servobench.drivers.exchange import NEVER_TOLD
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant

NONE_SENT = -1
"""In place of a controlword, which is an UNSIGNED16."""
FAULTY = (State.FAULT, State.FAULT_REACTION)
POLL_NS: Final = Duration(NS_PER_MS)
"""Interval between requests for a statusword by SDO: two frames of at most 135 bits, a quarter of 1
Mbit/s."""
_GIVEN: Final = frozenset(
    (int(each), 0)
    for each in (
        Object.CONTROLWORD,
        Object.MODES_OF_OPERATION,
        Object.TARGET_TORQUE,
        Object.TARGET_VELOCITY,
        Object.VL_TARGET_VELOCITY,
    )
)
"""Objects that the bench sets before an RPDO is sent; a torque or speed of another mode is 0."""
_RESEND_NS = 50 * NS_PER_MS
"""A controlword without effect for this long is sent again."""
_OLDER_WORDS_LIMIT = Duration(50 * NS_PER_MS)
"""A statusword by PDO is never under way for longer; if lost, its event timer repeats it."""
_FAULT_SPAN = Duration(100 * NS_PER_MS)
"""The EMCY of a fault precedes its statusword by no more: the event timer of such a TPDO, or the SDO that
reads it, takes less."""
_EMERGENCIES_KEPT = 64
"""Last EMCYs searched for that of a fault: a warning repeated every 2 ms keeps it for :data:`_FAULT_SPAN`."""
_EMERGENCIES_SHOWN = 2
"""EMCYs of different codes shown."""


class StateControl:
    """Commands and states of one drive. Every method but the properties pumps the network."""

    def __init__(self, objects: RemoteObjects, name: str, told: LastStatusword) -> None:
        self.objects = objects
        self.network = objects.network
        node, bus = f"node {objects.node_id}", objects.network.link.name
        self.title = f"{node} on {bus}" if name == node else f"{name} ({node} on {bus})"
        """The drive's name in errors."""
        self.set_point: SetPointFrames | None = None
        """Frames that carry the controlword by RPDO; None before the PDOs are mapped."""
        self.controlword = NONE_SENT
        """The controlword in force: the last one sent."""
        self.make = (0, "")
        """Vendor and device name, to look up its maker's texts; empty before they are read."""
        self._told = told
        self.emergencies: deque[Emergency] = deque(maxlen=_EMERGENCIES_KEPT)
        self.emergency_came = False
        """True if an EMCY came since this was cleared."""
        self.network.on_emergency(self._on_emergency)

    def read_state(self) -> State | None:
        """Read the state by SDO; None if the statusword is no coding of the standard."""
        return state_of(self.read_status())

    def await_older_words(self, plan: PdoPlan | None, deadline: Instant) -> None:
        """Wait for statuswords sent by PDO on the way to OPERATION ENABLED: a slow one would later look as if
        the drive fell back."""
        status = None if plan is None else plan.tpdo_with(Object.STATUSWORD)
        if status is None or status.synchronous:
            return
        until = min(deadline, self.network.deadline_after(_OLDER_WORDS_LIMIT))
        while state_of(self._told.by_pdo) is not State.OPERATION_ENABLED and self.network.pump_one(until):
            pass

    def read_status(self) -> int:
        """Read the statusword by SDO."""
        word = self.objects.read(Object.STATUSWORD, 0, "H")
        self._told.take(word, self.network.clock.now())
        return word

    def ask_after_emergency(self) -> None:
        """Request the statusword: an EMCY may be a warning, and the report of a fault may be lost.

        Does not wait, as a cycle is under way.
        """
        self.emergency_came = False

        def answered(data: bytes, at: Instant) -> None:
            self._told.take(int.from_bytes(data[:2], "little"), at)

        self.network.post_upload(self.objects.node_id, int(Object.STATUSWORD), 0, answered)

    def command(self, command: DriveCommand) -> None:
        """Put a controlword in force: by RPDO, so that none that waits for a SYNC undoes it, and by SDO."""
        self._put_in_force(CONTROLWORDS[command])

    def carry(self, frames: SetPointFrames, plan: PdoPlan, mode: Mode) -> None:
        """Have the RPDOs of ``plan`` carry controlword and set-points from now on; none is sent yet.

        A further object mapped there keeps the drive's value, or one written by SDO later, so that no frame
        changes it. Raises SettingRefused for one that cannot be read.
        """
        self.set_point, self.controlword = frames, NONE_SENT
        target = TARGETS.get(mode)
        given = _GIVEN if target is None else _GIVEN | {(target.index, target.sub)}
        further = {
            key: entry
            for pdo in plan.rpdos
            for entry in pdo.entries
            if (key := (entry.index, entry.sub)) not in given and entry.index >= FIRST_OBJECT
        }

        def hold(index: int, sub: int, data: bytes) -> None:
            entry = further.get((index, sub))
            if entry is not None:
                frames.hold(index, entry.value(data), sub)

        self.network.on_written[self.objects.node_id] = hold
        for key in further:
            try:
                hold(*key, self.network.upload(self.objects.node_id, *key))
            except TransferAborted as error:
                raise SettingRefused(
                    f"{self.title} maps {object_name(*key)} into an RPDO that the bench has to send",
                    f"what it holds cannot be read: {error.evidence}",
                    "take it out of the mapping with the maker's tool",
                ) from error

    def command_by_pdo(self, command: DriveCommand) -> None:
        """Put a controlword in force without waiting for anything; nothing happens before the mapping."""
        self.controlword = CONTROLWORDS[command]
        if self.set_point is not None:
            self.set_point.send_controlword(self.controlword)

    def set_bits(self, mask: int, value: int) -> None:
        """Change some bits of the controlword in force, by RPDO and by SDO."""
        held = max(self.controlword, 0)
        self._put_in_force(held & ~mask | value)

    def clear_bits(self, mask: int) -> None:
        """Clear bits of the controlword in force; nothing is sent if they are clear."""
        if self.controlword != NONE_SENT and self.controlword & mask:
            self.set_bits(mask, 0)

    def write_value(self, index: int, code: str, raw: int, sub: int = 0) -> None:
        """Write a set-point or the mode to the drive, by SDO and then in every RPDO that carries it.

        An RPDO that waits for a SYNC, or is sent later, so repeats the new value, not the old one. Before the
        first command no RPDO is sent, as it would be the one that brings a controlword. Raises ValueError if
        the value does not fit, TransferAborted if the drive refuses it; RPDOs then stay as they were.
        """
        self.objects.write(index, sub, code, raw)
        if self.set_point is not None:
            self.set_point.hold(index, raw, sub)
            if self.controlword != NONE_SENT:
                self.set_point.send(index, sub)

    def walk(self, target: State, deadline: Instant) -> None:
        """Follow the shortest path of the state machine; repeat a command without effect.

        Raises DriveInFault if a fault is met, or if the deadline comes first.
        """
        clock = self.network.clock
        sent: tuple[State | None, DriveCommand] | None = None
        resend_at = Instant(0)
        while (state := self.read_state()) is not target:
            now = clock.now()
            if state in FAULTY:
                raise self.in_fault()
            if now >= deadline:
                raise self.stuck(f"reach {target.value!r}")
            path = command_path(state, target) if state is not None else None
            if path and ((state, path[0]) != sent or now >= resend_at):
                self.command(path[0])
                sent, resend_at = (state, path[0]), Instant(now + _RESEND_NS)
            else:
                self.network.pump(Instant(now + POLL_NS))

    def await_state(
        self,
        reached: Callable[[State | None], bool],
        deadline: Instant,
        action: str,
        faults: bool = True,
        every: Duration = POLL_NS,
    ) -> State | None:
        """Poll the state, with pauses of ``every``, until it is as wanted, and return it.

        Raises DriveInFault at the deadline and, with ``faults``, when a fault is met.
        """
        while not reached(state := self.read_state()):
            if faults and state in FAULTY:
                raise self.in_fault()
            now = self.network.clock.now()
            if now >= deadline:
                raise self.stuck(action)
            self.network.pump(Instant(now + every))
        return state

    def evidence(self) -> str:
        """Return statusword, error code and last emergencies, as far as available."""
        parts = []
        try:
            parts.append(f"statusword {self.objects.read(Object.STATUSWORD, 0, 'H'):04X}h")
            parts += self._told_of_the_fault()
        except PeerFault as error:
            parts.append(str(error))
        now = self.network.clock.now()
        for each in condensed(self.emergencies)[-_EMERGENCIES_SHOWN:]:
            times = f", {each.times} times" if each.times > 1 else ""
            ago_ms = (now - each.last.at) / NS_PER_MS
            parts.append(f"{each.last.told(*self.make)}, {ago_ms:.0f} ms ago{times}")
        return ", ".join(parts)

    def _told_of_the_fault(self) -> list[str]:
        """Return 0x603F, or instead the newest entry of 0x1003; and 0x1001."""
        parts = []
        code = self.objects.read_if_there(Object.ERROR_CODE, 0, "H")
        if code is None and self.objects.read_if_there(Cia301.ERROR_HISTORY, 0, "B"):
            code = (self.objects.read_if_there(Cia301.ERROR_HISTORY, 1) or 0) & 0xFFFF
        if code is not None:
            parts.append(f"error code {code:04X}h ({fault_text(code, *self.make)})")
        register = self.objects.read_if_there(Cia301.ERROR_REGISTER, 0, "B")
        if register:
            parts.append(f"error register {register:02X}h ({register_text(register)})")
        return parts

    @property
    def status_told_at(self) -> Instant | None:
        """When the last statusword came, by PDO or SDO; None before the first."""
        return None if self._told.at == NEVER_TOLD else self._told.at

    @property
    def fault_seen_at(self) -> Instant:
        """When the present fault first showed: by its EMCY, or by the statusword itself."""
        since = self._told.at - _FAULT_SPAN
        return min(
            (each.at for each in self.emergencies if each.code and each.at >= since), default=self._told.at
        )

    def in_fault(self) -> DriveInFault:
        """Return the error for a drive that reports a fault."""
        seen_at = self.fault_seen_at
        return DriveInFault(
            f"{self.title} is in fault", self.evidence(), "remove the cause, then reset the fault", seen_at
        )

    def stuck(self, action: str) -> DriveInFault:
        """Return the error for a drive that did not comply by the deadline."""
        return DriveInFault(f"{self.title} did not {action} in time", self.evidence())

    def _put_in_force(self, controlword: int) -> None:
        self.controlword = controlword
        if self.set_point is not None:
            self.set_point.send_controlword(controlword)
        self.objects.write(Object.CONTROLWORD, 0, "H", controlword)

    def _on_emergency(self, emergency: Emergency) -> None:
        if emergency.node_id == self.objects.node_id:
            self.emergencies.append(emergency)
            self.emergency_came = True
