"""Receive PDOs: immediate (254, 255) or at the next SYNC (0..240), with deadline (CiA 301, 7.2.2)."""

from typing import Final

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import RPDO_COMMUNICATION, RPDO_MAPPING
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.application import CommunicationLoss
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.pdo_codec import byte_length, compile_unpacker
from servobench.virtual_bus.device.pdo_parameters import PdoParameters
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

PDO_TOO_SHORT: Final = 0x8210
PDO_TOO_LONG: Final = 0x8220
PDO_DEADLINE: Final = 0x8250
SYNCHRONOUS_TYPE_MAX: Final = 240
_OPERATIONAL: Final = NmtState.OPERATIONAL


class ReceivePdo(PdoParameters):
    """One RPDO. Out-of-range values are counted in ``refused`` and the variable keeps its value."""

    reserved_types = range(241, 254)
    transmit = False

    def __init__(self, station: Station, emergency: EmergencyProducer, number: int) -> None:
        """``number``: 1.. as in RPDO1."""
        super().__init__(station, RPDO_COMMUNICATION + number - 1, RPDO_MAPPING + number - 1)
        self.refused = 0
        self._emergency = emergency
        self._number = number
        self._listening: int | None = None
        self.waiting: bytes | None = None
        """Data of a synchronous RPDO since the last SYNC."""
        self._variables: list[Variable] = []
        self._unpack = compile_unpacker([])
        self._length = 0
        self._synchronous = False
        self._deadline_ns = 0
        self._missed = False
        self._wrong_length = 0
        self._deadline = station.timers.create(self._on_deadline)
        self.window_open = True
        """Cleared by the SYNC consumer when the synchronous window (1007h) is over."""

    def configure(self) -> None:
        """Take over COB-ID, type, mapping and deadline."""
        if self._listening is not None:
            self.station.ignore(self._listening, self._on_frame)
            self._listening = None
        fields = self.fields()
        self._variables = [field.variable for field in fields if field.variable is not None]
        self._unpack = compile_unpacker(fields)
        self._length = byte_length(fields)
        self._synchronous = self.parameter(2) <= SYNCHRONOUS_TYPE_MAX
        self._deadline_ns = self.parameter(5) * NS_PER_MS
        self.waiting = None
        # The deadline counts from the next reception, so a change starts from anew.
        self._deadline.stop()
        if self.exists:
            self._listening = self.can_id
            self.station.listen(self._listening, self._on_frame)

    def leave_operational(self) -> None:
        """PDOs exist in OPERATIONAL only: forget what waits for a SYNC, and the deadline."""
        self.waiting = None
        self._deadline.stop()

    def actuate(self) -> None:
        """A SYNC: what came since the last one takes effect."""
        data = self.waiting
        if data is not None:
            self.waiting = None
            self._apply(data)

    def _on_frame(self, frame: Frame, now: Instant) -> None:
        if self.station.state is not _OPERATIONAL:
            return
        data = frame.data
        if len(data) != self._length or self._wrong_length:
            self._judge_length(len(data))
            if len(data) < self._length:
                return
        if self._deadline_ns:
            self._restart_deadline(now)
        if not self._synchronous:
            self._apply(data)
        elif self.window_open:
            self.waiting = data

    def _apply(self, data: bytes) -> None:
        """Store every value, then let the application act on them; the cyclic path, so without detours."""
        values = self._unpack(data)
        refused: tuple[Variable, ...] = ()
        variables = self._variables
        for place, variable in enumerate(variables):
            value = values[place]
            if variable.refusal(value) is None:
                variable.value = value
            else:
                refused = (*refused, variable)
        if refused:
            self.refused += len(refused)
        for place, variable in enumerate(variables):
            hook = variable.on_write
            if hook is not None and (not refused or variable not in refused):
                hook(values[place])

    def _judge_length(self, length: int) -> None:
        """8210h: too short, not processed. 8220h: too long, the first bytes are. (CiA 301, table 26)."""
        code = 0
        if length != self._length:
            code = PDO_TOO_SHORT if length < self._length else PDO_TOO_LONG
        if code == self._wrong_length:
            return
        if self._wrong_length:
            self._emergency.clear_error(self._wrong_length, self._number)
        self._wrong_length = code
        if code:
            self._emergency.raise_error(code, ErrorRegister.COMMUNICATION, source=self._number)

    def _restart_deadline(self, now: Instant) -> None:
        self._deadline.start(Instant(now + self._deadline_ns))
        if self._missed:
            self._missed = False
            self._emergency.clear_error(PDO_DEADLINE, self._number)

    def _on_deadline(self, now: Instant) -> None:
        self._missed = True
        self._emergency.raise_error(PDO_DEADLINE, ErrorRegister.COMMUNICATION, source=self._number)
        self.station.application.on_communication_loss(CommunicationLoss.RPDO_DEADLINE, 0, now)

    def forget_errors(self) -> None:
        """At a reset: no error of the past is to be cleared later."""
        self._missed = False
        self._wrong_length = 0
