"""Transmit PDOs of every transmission type (CiA 301, 7.2.2 and 7.5.2.37).

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

from typing import Final

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import TPDO_COMMUNICATION, TPDO_MAPPING, Cia301
from servobench.drivers.timebase import NS_PER_100_US, NS_PER_MS, Instant
from servobench.virtual_bus.core.native import CyclicTpdo
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.pdo_codec import compiled
from servobench.virtual_bus.device.pdo_parameters import PdoParameters
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

SYNCHRONOUS_ACYCLIC: Final = 0
SYNCHRONOUS_CYCLIC_MAX: Final = 240
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
