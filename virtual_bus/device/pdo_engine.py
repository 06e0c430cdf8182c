"""All PDOs of a device, and what a change of the NMT state does to them.

Receive PDOs: immediate (254, 255) or at the next SYNC (0..240), with deadline (CiA 301, 7.2.2).

Transmit PDOs of every transmission type (CiA 301, 7.2.2 and 7.5.2.37).

    0          synchronous acyclic: at the next SYNC after an event
    1..240     synchronous cyclic: at every n-th SYNC, from the SYNC start value on
    252        sampled at each SYNC, sent on a remote request
    253        sampled and sent on a remote request
    254, 255   sent on an event, by the event timer, not more often than the inhibit time allows

A remote request (allowed by bit 30 = 0 of the COB-ID) of the other types sends the last sample of a
synchronous PDO, or a fresh one of an event-driven PDO.

The event of types 0, 254 and 255 is that a mapped object holds another value than at the last look. The
device looks whenever it has done something (core/device.c). What is done at a SYNC is in core/tpdo_type.c.
1013h is no event: a clock that runs tells nothing.
"""

from collections import deque
from typing import Final

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import (
    MAPPING_OFFSET,
    PDOS_MAX,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    Cia301,
)
from servobench.drivers.timebase import NS_PER_100_US, NS_PER_MS, Duration, Instant
from servobench.virtual_bus.core.native import CyclicRpdo, CyclicTpdo
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary, Variable
from servobench.virtual_bus.device.pdo_parameters import PdoParameters, compiled
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import CommunicationLoss, Handler, Station
from servobench.virtual_bus.frame import Frame

_OPERATIONAL: Final = NmtState.OPERATIONAL


class PdoEngine:
    """Makes a PDO of each communication parameter object that the dictionary holds (1400h.., 1800h..)."""

    def __init__(self, station: Station, emergency: EmergencyProducer) -> None:
        dictionary = station.dictionary
        self.receive = [ReceivePdo(station, emergency, n) for n in _numbers(dictionary, RPDO_COMMUNICATION)]
        self.transmit = [TransmitPdo(station, n) for n in _numbers(dictionary, TPDO_COMMUNICATION)]
        station.cycle.carry([tpdo.turn for tpdo in self.transmit], [rpdo.reception for rpdo in self.receive])

    def reset_communication(self) -> None:
        """Take all parameters from the dictionary."""
        for rpdo in self.receive:
            rpdo.forget_errors()
            rpdo.configure()
        for tpdo in self.transmit:
            tpdo.configure()

    def on_state(self, state: NmtState, _now: Instant) -> None:
        """PDOs are alive in OPERATIONAL only (CiA 301, table 38)."""
        for tpdo in self.transmit:
            if state is _OPERATIONAL:
                tpdo.enter_operational()
            else:
                tpdo.leave_operational()
        if state is not _OPERATIONAL:
            for rpdo in self.receive:
                rpdo.leave_operational()


def _numbers(dictionary: ObjectDictionary, first: int) -> list[int]:
    """PDOs whose COB-ID, transmission type and mapping are there; a vendor's file may lack some."""
    needed = ((first, 1), (first, 2), (first + MAPPING_OFFSET, 0))
    return [
        place + 1
        for place in range(PDOS_MAX)
        if all(dictionary.get(index + place, subindex) is not None for index, subindex in needed)
    ]


PDO_TOO_SHORT: Final = 0x8210
PDO_TOO_LONG: Final = 0x8220
PDO_DEADLINE: Final = 0x8250
SYNCHRONOUS_CYCLIC_MAX: Final = 240


class ReceivePdo(PdoParameters):
    """One RPDO. Of a value out of range the variable keeps the one that it has (core/rpdo_type.c)."""

    reserved_types = range(241, 254)
    transmit = False

    def __init__(self, station: Station, emergency: EmergencyProducer, number: int) -> None:
        """``number``: 1.. as in RPDO1."""
        super().__init__(station, RPDO_COMMUNICATION + number - 1, RPDO_MAPPING + number - 1)
        self._emergency = emergency
        self._number = number
        self._listening: int | None = None
        self._deadline = deadline = station.timer(self._on_deadline)
        self._held: deque[tuple[Instant, Frame]] = deque()
        """Frames that the task has not taken in, and when it will."""
        self._holding = station.timer(self._on_due)
        self.reception: Final = CyclicRpdo(
            station.cycle, self._judge_length, deadline, self._deadline_met, compiled([])
        )

    def configure(self) -> None:
        """Take over COB-ID, type, mapping and deadline."""
        if self._listening is not None:
            self.station.ignore(self._listening, self._handler)
            self._listening = None
        self.reception.map(compiled(self.fields()))
        self.reception.synchronous = self.parameter(2) <= SYNCHRONOUS_CYCLIC_MAX
        self.reception.deadline_ns = Duration(self.parameter(5) * NS_PER_MS)
        self._forget()
        # The deadline counts from the next reception, so a change starts from anew.
        self._deadline.stop()
        if self.exists:
            self._listening = self.can_id
            self.station.listen(self._listening, self._handler)

    def leave_operational(self) -> None:
        """PDOs exist in OPERATIONAL only: forget what waits for a SYNC, and the deadline."""
        self._forget()
        self._deadline.stop()

    @property
    def _handler(self) -> Handler:
        return self.reception if self.station.receiving is None else self._hold

    def _hold(self, frame: Frame, now: Instant) -> None:
        assert self.station.receiving is not None
        self._held.append((self.station.receiving.due(now), frame))
        self._holding.start(self._held[0][0])

    def _on_due(self, now: Instant) -> None:
        while self._held and self._held[0][0] <= now:
            self.reception.take(self._held.popleft()[1], now)
        if self._held:
            self._holding.start(self._held[0][0])

    def _forget(self) -> None:
        """What waits for the task, or for a SYNC, does not take effect."""
        self._held.clear()
        self._holding.stop()
        self.reception.forget_waiting()

    def _judge_length(self, length: int) -> None:
        """8210h: too short, not processed. 8220h: too long, the first bytes are. (CiA 301, table 26)."""
        code, reception = 0, self.reception
        if length != reception.length:
            code = PDO_TOO_SHORT if length < reception.length else PDO_TOO_LONG
        if code == reception.wrong_length:
            return
        if reception.wrong_length:
            self._emergency.clear_error(reception.wrong_length, self._number)
        reception.wrong_length = code
        if code:
            self._emergency.raise_error(code, ErrorRegister.COMMUNICATION, source=self._number)

    def _deadline_met(self) -> None:
        self._emergency.clear_error(PDO_DEADLINE, self._number)

    def _on_deadline(self, now: Instant) -> None:
        self.reception.missed = True
        self._emergency.raise_error(PDO_DEADLINE, ErrorRegister.COMMUNICATION, source=self._number)
        self.station.application.on_communication_loss(CommunicationLoss.RPDO_DEADLINE, 0, now)

    def forget_errors(self) -> None:
        """At a reset: no error of the past is to be cleared later."""
        self.reception.missed = False
        self.reception.wrong_length = 0


SYNCHRONOUS_ACYCLIC: Final = 0
REMOTE_SYNCHRONOUS: Final = 252
REMOTE_EVENT: Final = 253


class TransmitPdo(PdoParameters):
    """One TPDO."""

    reserved_types = range(241, 252)
    transmit = True

    def __init__(self, station: Station, number: int) -> None:
        """``number``: 1.. as in TPDO1."""
        super().__init__(station, TPDO_COMMUNICATION + number - 1, TPDO_MAPPING + number - 1)
        self.turn: Final = CyclicTpdo(station.cycle, self._on_event, compiled([]), compiled([]))
        self._complete = False
        """It exists and maps something."""
        self._active = False
        self._inhibit_ns = 0
        self._event_ns = 0
        self._free_at = Instant(0)
        self._remote: int | None = None
        self._inhibit_timer = station.timer(self._on_inhibit_over)
        self._event_timer = station.timer(self._on_event_timer)
        for subindex, check in ((3, self.refused_while_it_exists), (6, self._check_start)):
            index = TPDO_COMMUNICATION + number - 1
            station.dictionary.hook(index, subindex, check=check, on_write=self._on_write)

    @property
    def _event_driven(self) -> bool:
        """Types 254 and 255."""
        return self.turn.type > REMOTE_EVENT

    def configure(self) -> None:
        """Take over COB-ID, type, mapping and timers."""
        fields, turn = self.fields(), self.turn
        watched = [field for field in fields if field.variable is not None and _tells(field.variable)]
        turn.map(compiled(fields), compiled(watched))
        turn.runs = any(
            field.variable is not None and field.variable.provider is not None for field in watched
        )
        turn.can_id = self.can_id
        turn.type = self.parameter(2)
        self._inhibit_ns = self.parameter(3) * NS_PER_100_US
        self._event_ns = self.parameter(5) * NS_PER_MS
        self._listen_for_remote(self.exists and not self.parameter(1) & cob_ids.NO_RTR)
        announce = not self._active
        self._stop()
        self._complete = self.exists and bool(fields)
        if self._complete and self.station.state is NmtState.OPERATIONAL:
            self._begin(announce)

    def enter_operational(self) -> None:
        """Cycles start; an event-driven PDO tells its values once."""
        if self._complete:
            self._begin(announce=True)

    def leave_operational(self) -> None:
        """PDOs exist in OPERATIONAL only."""
        self._stop()

    def _begin(self, announce: bool) -> None:
        now, turn = self.station.now, self.turn
        self._active = True
        turn.follows_sync = turn.type <= REMOTE_SYNCHRONOUS
        turn.left = turn.type
        turn.start_at = self.parameter(6) if self.station.value(Cia301.SYNC_COUNTER_OVERFLOW) else 0
        turn.latch()
        self._free_at = now
        turn.event = turn.type == SYNCHRONOUS_ACYCLIC
        if turn.event or self._event_driven:
            self.station.cycle.watch(turn)
            turn.look()
        if self._event_driven and announce:
            self._transmit_event(now)
        elif self._event_driven and self._event_ns:
            self._event_timer.start(Instant(now + self._event_ns))

    def _stop(self) -> None:
        self._active = False
        self.turn.follows_sync = self.turn.event = False
        self.station.cycle.unwatch(self.turn)
        self._inhibit_timer.stop()
        self._event_timer.stop()

    def _on_event(self, now: Instant) -> None:
        task, free_at = self.station.sending, self._free_at
        if task is not None:
            free_at = task.due(max(now, free_at))
        if now >= free_at:
            self._transmit_event(now)
        else:
            self.turn.event = True
            self._inhibit_timer.start(free_at)

    def _on_inhibit_over(self, now: Instant) -> None:
        if self.turn.event:
            self._transmit_event(now)

    def _on_event_timer(self, now: Instant) -> None:
        self._on_event(now)
        if self.turn.event:
            # Held back by the inhibit time: that transmission starts the timer again.
            self._event_timer.stop()

    def _transmit_event(self, now: Instant) -> None:
        self.turn.event = False
        self._free_at = Instant(now + self._inhibit_ns)
        if self._event_ns:
            self._event_timer.start(Instant(now + self._event_ns))
        self.turn.transmit()

    def _listen_for_remote(self, allowed: bool) -> None:
        if self._remote is not None:
            self.station.ignore(self._remote, self._on_remote, remote=True)
        self._remote = self.turn.can_id if allowed else None
        if self._remote is not None:
            self.station.listen(self._remote, self._on_remote, remote=True)

    def _on_remote(self, _frame: Frame, _now: Instant) -> None:
        if not self._active:
            return
        if self.turn.type <= REMOTE_SYNCHRONOUS:
            self.turn.send_latched()
        else:
            self.turn.transmit()

    def _check_start(self, value: int) -> AbortCode | None:
        if value > SYNCHRONOUS_CYCLIC_MAX:
            return AbortCode.INVALID_VALUE
        return self.refused_while_it_exists(value)


def _tells(variable: Variable) -> bool:
    """Whether a change of it is an event."""
    return variable.index != Cia301.HIGH_RESOLUTION_TIME_STAMP
