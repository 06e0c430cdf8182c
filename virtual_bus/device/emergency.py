"""EMCY producer: error register 1001h, history 1003h, COB-ID 1014h, inhibit time 1015h.

CiA 301, 7.2.7 and 7.5.2.2..7.5.2.18. An error is active from ``raise_error`` to ``clear_error``; its
cause is told apart by ``source`` where one code has several (two lost heartbeats).
"""

from collections import deque

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.error_codes import NO_ERROR, ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.timebase import NS_PER_100_US, Instant
from servobench.virtual_bus.device.object_dictionary import Provider
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

_MAY_SEND = frozenset({NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL})
_QUEUE_MAX = 32
"""Messages that wait for their inhibit time. A simulated drive has fewer causes of errors, each reported once
while it lasts: length and deadline of four RPDOs, four heartbeats, guarding, SYNC, bus-off, its own five."""


class EmergencyProducer:
    """Sends EMCY messages and keeps the error objects."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._active: dict[tuple[int, int], ErrorRegister] = {}
        self._queue: deque[bytes] = deque(maxlen=_QUEUE_MAX)
        self._timer = station.timer(self._send_queued)
        self._free_at = Instant(0)
        self._history: deque[int] = deque()
        self._attach()

    def _attach(self) -> None:
        dictionary = self._station.dictionary
        dictionary.hook(Cia301.EMCY_COB_ID, check=self._check_cob_id)
        if Cia301.ERROR_HISTORY not in dictionary:
            return
        members = dictionary.object(Cia301.ERROR_HISTORY).members
        members[0].provider = lambda: len(self._history)
        members[0].check = lambda value: None if value == 0 else AbortCode.INVALID_VALUE
        members[0].on_write = lambda _value: self._history.clear()
        self._history = deque(maxlen=len(members) - 1)
        for subindex, variable in members.items():
            if subindex:
                variable.provider = self._entry_provider(subindex)

    def _entry_provider(self, subindex: int) -> Provider:
        def entry() -> int:
            if subindex > len(self._history):
                raise SdoAbort(AbortCode.NO_DATA)
            return self._history[subindex - 1]

        return entry

    def raise_error(
        self, code: int, register: ErrorRegister, information: bytes = b"", source: int = 0
    ) -> None:
        """An error appeared; nothing happens if it is active already."""
        if (code, source) in self._active:
            return
        self._active[code, source] = register
        self._history.appendleft(code | int.from_bytes(information[:2], "little") << 16)
        self._post(code, information)

    def repeat_error(self, code: int, register: ErrorRegister) -> None:
        """Raise an error; report one that is active already again. See :meth:`raise_error`."""
        if (code, 0) in self._active:
            self._history.appendleft(code)
            self._post(code, b"")
        else:
            self.raise_error(code, register)

    def clear_error(self, code: int, source: int = 0) -> None:
        """An error is gone, if it was active: EMCY 0000h tells so, with what is left in 1001h."""
        if self._active.pop((code, source), None) is not None:
            self._post(NO_ERROR, b"")

    def reset_communication(self) -> None:
        """Forget what waits to be sent, and errors of the communication, without an EMCY."""
        self._forget_queue()
        self._active = {
            key: register
            for key, register in self._active.items()
            if not register & ErrorRegister.COMMUNICATION
        }

    def reset_node(self) -> None:
        """Forget all errors and the history."""
        self._forget_queue()
        self._active.clear()
        self._history.clear()

    def _forget_queue(self) -> None:
        self._queue.clear()
        self._timer.stop()
        self._free_at = self._station.now

    def on_state(self, state: NmtState, now: Instant) -> None:
        """Send EMCYs that waited for a state in which they are allowed."""
        if state in _MAY_SEND:
            self._send_queued(now)

    def update_register(self) -> int:
        """1001h from the active errors; returns it."""
        register = ErrorRegister(0)
        for bits in self._active.values():
            # Bit 0 is set with every error, 7.5.2.2.
            register |= bits | ErrorRegister.GENERIC
        variable = self._station.dictionary.get(Cia301.ERROR_REGISTER)
        if variable is not None:
            variable.value = int(register)
        return int(register)

    def _post(self, code: int, information: bytes) -> None:
        register = self.update_register()
        self._queue.append(code.to_bytes(2, "little") + bytes([register]) + information[:5].ljust(5, b"\x00"))
        self._send_queued(self._station.now)

    def _send_queued(self, now: Instant) -> None:
        station = self._station
        inhibit_ns = station.value(Cia301.EMCY_INHIBIT_TIME) * NS_PER_100_US
        while self._queue and station.state in _MAY_SEND and now >= self._free_at:
            cob = station.value(Cia301.EMCY_COB_ID)
            message = self._queue.popleft()
            if cob and not cob & cob_ids.NOT_VALID:
                station.send(Frame(cob & cob_ids.CAN_ID, message))
                self._free_at = Instant(now + inhibit_ns)
        if self._queue and station.state in _MAY_SEND:
            self._timer.start(self._free_at)

    def _check_cob_id(self, value: int) -> AbortCode | None:
        """1014h, 7.5.2.17: bits 0..29 stay while the EMCY exists."""
        present = self._station.value(Cia301.EMCY_COB_ID)
        valid = not value & cob_ids.NOT_VALID
        if value & (cob_ids.EXTENDED | cob_ids.NO_RTR):
            return AbortCode.INVALID_VALUE
        if valid and not present & cob_ids.NOT_VALID and value != present:
            return AbortCode.INVALID_VALUE
        if valid and cob_ids.restricted(value & cob_ids.CAN_ID):
            return AbortCode.INVALID_VALUE
        return None
