"""Consumer of SYNC (CiA 301, 7.2.5 and 7.5.2.5..7.5.2.22): 1005h, 1006h, 1007h and the counter of 1019h.

1012h, of TIME, is kept and checked; nothing here has a use for the master's calendar.

When a device acts on a SYNC: at once, as late as its task wakes, or by a cycle locked to the SYNCs.

    SYNC ends     |         |           |        |          |      with the jitter of its producer
    task            |           |         |         |         |    late by 0 to the jitter, drawn for each
    cycle            |         |         |         |         |     a phase behind the filtered SYNC

Drives with a locked cycle and a phase to set: Infranor XtrapulsGem (2006h, a PLL, off while 1006h is 0) and
Lenze ECS (C1122).
"""

from collections import deque
from typing import Final

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.virtual_bus.core.native import DeviceClock, SyncTaker
from servobench.virtual_bus.device.device_options import SyncOptions
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.faults.fault_streams import UniformStream

SYNC_LENGTH: Final = 0x8240
"""EMCY: unexpected SYNC data length (CiA 301, table 26)."""
_PRODUCES: Final = 1 << 30
COUNTER_MAX: Final = 240
_OPERATIONAL: Final = NmtState.OPERATIONAL
_PRE_OPERATIONAL: Final = NmtState.PRE_OPERATIONAL


class SyncConsumer:
    """With what core/sync_type.c takes SYNCs in PRE-OPERATIONAL and OPERATIONAL, and hands them to the PDOs
    and the application."""

    def __init__(
        self,
        station: Station,
        emergency: EmergencyProducer,
        clock: DeviceClock,
        options: SyncOptions,
        locks: bool = False,
    ) -> None:
        """``locks``: the tasks of PDOs count from SYNCs."""
        self._station = station
        tasks = (station.receiving, station.sending) if locks else ()
        self._locked = [task for task in tasks if task is not None]
        at_once = options.at_once and station.sending is None and not self._locked
        self._task = None if at_once else SyncTask(options, f"SYNC {station.node_id}")
        self._held: deque[tuple[Instant, int]] = deque()
        """SYNCs that the task has not acted on: when it will, and their counters."""
        self._holding = station.timer(self._on_due)
        self._emergency = emergency
        self._listening: int | None = None
        hold = None if self._task is None else self._hold
        self._taker: Final = SyncTaker(station.cycle, clock, self._judge_length, hold)
        self._window_ns = 0
        self._window = station.timer(self._on_window_over)
        dictionary = station.dictionary
        dictionary.hook(Cia301.SYNC_COB_ID, check=self._check_cob_id, on_write=self._on_write)
        dictionary.hook(Cia301.SYNC_WINDOW, on_write=self._on_write)
        dictionary.hook(
            Cia301.SYNC_COUNTER_OVERFLOW, check=self._check_counter_overflow, on_write=self._on_write
        )
        dictionary.hook(Cia301.TIME_COB_ID, check=self._check_cob_id)

    def reset_communication(self) -> None:
        """Take all parameters from the dictionary."""
        self._taker.wrong_length = False
        self._held.clear()
        self._holding.stop()
        self._on_write(0)

    def _on_write(self, _value: int) -> None:
        station = self._station
        if self._listening is not None:
            station.ignore(self._listening, self._taker)
        self._listening = self._cob_id() & cob_ids.CAN_ID or None
        self._taker.length = 1 if station.value(Cia301.SYNC_COUNTER_OVERFLOW) else 0
        self._window_ns = station.value(Cia301.SYNC_WINDOW) * NS_PER_US
        self._taker.open_window = self._open_window if self._window_ns else None
        self._window.stop()
        station.cycle.open_window(True)
        if self._listening is not None:
            station.listen(self._listening, self._taker)

    def _cob_id(self) -> int:
        """Return the COB-ID of 1005h; a vendor's data sheet may lack the object, and the drive uses 080h
        anyway."""
        try:
            return int(self._station.dictionary.variable(Cia301.SYNC_COB_ID).read())
        except KeyError:
            return 0

    def _open_window(self, now: Instant) -> None:
        self._station.cycle.open_window(True)
        self._window.start(Instant(now + self._window_ns))

    def _hold(self, counter: int, now: Instant) -> None:
        assert self._task is not None
        period_ns = self._station.value(Cia301.CYCLE_PERIOD) * NS_PER_US
        due, sending = self._task.due(now, period_ns), self._station.sending
        for task in self._locked:
            task.begin(due)
        self._held.append((due if sending is None else sending.due(due), counter))
        self._holding.start(self._held[0][0])

    def _on_due(self, now: Instant) -> None:
        while self._held and self._held[0][0] <= now:
            self._station.cycle.sync(self._held.popleft()[1])
        if self._held:
            self._holding.start(self._held[0][0])

    def _on_window_over(self, _now: Instant) -> None:
        self._station.cycle.open_window(False)

    def _judge_length(self, length: int) -> None:
        """EMCY 8240h once, until a right one comes. A counter that is not expected (1019h = 0) is passed
        over; a SYNC without the one that is expected is not taken."""
        taker = self._taker
        wrong = length != taker.length
        if wrong and not taker.wrong_length:
            self._emergency.raise_error(SYNC_LENGTH, ErrorRegister.COMMUNICATION)
        elif taker.wrong_length and not wrong:
            self._emergency.clear_error(SYNC_LENGTH)
        taker.wrong_length = wrong

    def _check_cob_id(self, value: int) -> AbortCode | None:
        # 7.5.2.5, 7.5.2.15: 06090030h for bit 30, as it produces neither, and for bit 29 with 11 bits only.
        if value & (_PRODUCES | cob_ids.EXTENDED) or cob_ids.restricted(value & cob_ids.CAN_ID):
            return AbortCode.INVALID_VALUE
        return None

    def _check_counter_overflow(self, value: int) -> AbortCode | None:
        # 7.5.2.22: 08000022h while the communication cycle period is not 0; 1 and 241.. are reserved.
        if self._station.value(Cia301.CYCLE_PERIOD):
            return AbortCode.DEVICE_STATE
        return AbortCode.INVALID_VALUE if value == 1 or value > COUNTER_MAX else None


PHASE_GAIN: Final = 1.0 / 16.0
"""By what part of its error the cycle is moved with each SYNC: a fifth of the spread of a jitter is left."""
PERIOD_GAIN: Final = 1.0 / 512.0
"""The same for its period; damping PHASE_GAIN / (2 sqrt(PERIOD_GAIN)) = 0.7."""


class SyncTask:
    """Tells when each SYNC is acted on; in the order in which they came."""

    def __init__(self, options: SyncOptions, name: str) -> None:
        """``name``: of the stream of its jitter, beside the seed."""
        self._jitter_ns, self._phase_ns = options.jitter_ns, options.phase_ns
        self._draw = UniformStream(options.seed, name)
        self._last_due = Instant(0)
        self._nominal_ns = 0
        self._cycle_at = self._period_ns = 0.0

    def due(self, came_at: Instant, period_ns: int) -> Instant:
        """When the SYNC whose frame ended at ``came_at``, the newest, is acted on. ``period_ns``: of SYNCs,
        1006h; 0: nothing is locked to them."""
        due = came_at
        if self._phase_ns is not None and period_ns:
            due = self._locked(came_at, self._phase_ns, period_ns)
        if self._jitter_ns:
            due = Instant(due + int(self._draw.draw() * (self._jitter_ns + 1)))
        self._last_due = due = max(due, self._last_due)
        return due

    def _locked(self, came_at: Instant, phase_ns: int, nominal_ns: int) -> Instant:
        """A phase behind the filtered SYNC; not before the SYNC itself has come."""
        if nominal_ns != self._nominal_ns:
            self._nominal_ns = nominal_ns
            self._cycle_at, self._period_ns = float(came_at), float(nominal_ns)
        else:
            cycles = round((came_at - self._cycle_at) / self._period_ns)
            expected_at = self._cycle_at + cycles * self._period_ns
            error_ns = came_at - expected_at
            self._cycle_at = expected_at + PHASE_GAIN * error_ns
            self._period_ns += PERIOD_GAIN * error_ns
        return max(came_at, Instant(int(self._cycle_at) + phase_ns))
