"""LSS slave: give a device its node-ID over the bus (CiA 305).

    WAITING        switch state (global, selective), identify, fast scan
    CONFIGURATION  the same but fast scan, and: configure, store, inquire

A node-ID that was configured takes effect with the next reset of the communication; in a device
that had none, at once when it is switched back to WAITING. Answers are on 7E4h, requests on 7E5h,
both always 8 bytes.

A bit rate that was configured takes effect when it is activated, or stored and then at power-on:

    activate bit timing --- switch delay ---> bit rate changes --- switch delay, silent ---> goes on

It is the host's controller that runs at that rate; where the host cannot set one, nothing changes.
"""

from collections.abc import Callable
from enum import IntEnum

from servobench.drivers.canopen.cob_ids import LSS_ANSWER, LSS_REQUEST
from servobench.drivers.canopen.lss import SCAN_RESET
from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, UNCONFIGURED
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.parameter_storage import ParameterStore
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

NODE_ID_KEY = (0x0000, 1)
"""Where the node-ID is kept in the parameter store: no object has this index."""
BIT_RATE_KEY = (0x0000, 2)
_TABLE_BIT_S = (1_000_000, 800_000, 500_000, 250_000, 125_000, 0, 50_000, 20_000, 10_000)
BIT_RATES = {index: bit_s for index, bit_s in enumerate(_TABLE_BIT_S) if bit_s}
"""The standard bit timing table, bit/s by index; 5 is reserved, 9 (detected by itself) is not offered."""


class Lss(IntEnum):
    """Command specifiers."""

    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE = 0x17
    SELECT_FIRST = 0x40
    SELECT_LAST = 0x43
    SELECTED = 0x44
    IDENTIFY_FIRST = 0x46
    IDENTIFY_LAST = 0x4B
    IDENTIFY_UNCONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    IDENTIFIED_UNCONFIGURED = 0x50
    FAST_SCAN = 0x51
    INQUIRE_FIRST = 0x5A
    INQUIRE_LAST = 0x5D
    INQUIRE_NODE_ID = 0x5E


class LssSlave:
    """The LSS state of one device; ``activate`` lets the pending node-ID take effect, with boot-up."""

    def __init__(self, station: Station, store: ParameterStore, activate: Callable[[Instant], None]) -> None:
        self._station = station
        self._store = store
        self._activate = activate
        self.configuring = False
        """In CONFIGURATION."""
        self.scan_answered_in_configuration = False
        """Answer each frame of a fast scan in CONFIGURATION, as CANopenNode does; by CiA 305 it is silent."""
        self._made_with = station.node_id
        self.pending_node_id = station.node_id
        """Takes effect with the next reset of the communication."""
        self._pending_bit_rate: int | None = None
        self._set_bit_rate: Callable[[int], None] = lambda _bit_rate: None
        """Sets the bit rate of the host's controller, if possible."""
        self._switch_delay_ns = 0
        self._timer = station.timer(self._on_switch_delay)
        self._selected = 0
        self._identified = 0
        self._scanned = 0
        self._services: dict[int, Callable[[bytes, Instant], None]] = {
            Lss.SWITCH_GLOBAL: self._switch,
            Lss.IDENTIFY_UNCONFIGURED: self._identify_unconfigured,
            Lss.FAST_SCAN: self._fast_scan,
            **dict.fromkeys(range(Lss.SELECT_FIRST, Lss.SELECT_LAST + 1), self._select),
            **dict.fromkeys(range(Lss.IDENTIFY_FIRST, Lss.IDENTIFY_LAST + 1), self._identify),
        }
        self._services_in_configuration: dict[int, Callable[[bytes, Instant], None]] = {
            Lss.CONFIGURE_NODE_ID: self._configure_node_id,
            Lss.CONFIGURE_BIT_TIMING: self._configure_bit_timing,
            Lss.ACTIVATE_BIT_TIMING: self._activate_bit_timing,
            Lss.STORE: self._save,
            Lss.INQUIRE_NODE_ID: self._inquire_node_id,
            **dict.fromkeys(range(Lss.INQUIRE_FIRST, Lss.INQUIRE_LAST + 1), self._inquire),
        }
        station.listen(LSS_REQUEST, self._on_request)

    def follow_bit_rate(self, set_bit_rate: Callable[[int], None]) -> None:
        """Call ``set_bit_rate(bit/s)`` when the host's controller is to run at another rate."""
        self._set_bit_rate = set_bit_rate

    def power_on(self) -> None:
        """WAITING, with the stored node-ID and bit rate, or else those of the device's making."""
        self.configuring = False
        self._selected = self._identified = self._scanned = 0
        self._timer.stop()
        self._station.cycle.mute = False
        kept = self._store.load()
        stored = kept.get(NODE_ID_KEY)
        self.pending_node_id = stored[0] if stored else self._made_with
        rate = kept.get(BIT_RATE_KEY)
        self._pending_bit_rate = rate[0] if rate else None
        if rate:
            self._set_bit_rate(BIT_RATES[rate[0]])

    def _on_request(self, frame: Frame, now: Instant) -> None:
        if len(frame.data) != 8:
            return
        service = self._services.get(frame.data[0])
        if service is None and self.configuring:
            service = self._services_in_configuration.get(frame.data[0])
        if service is not None:
            service(frame.data, now)

    def _answer(self, command: int, data: bytes = b"") -> None:
        self._station.send(Frame(LSS_ANSWER, (bytes([command]) + data).ljust(8, b"\x00")))

    def _identity(self, part: int) -> int:
        """Vendor-ID, product code, revision number, serial number."""
        return self._station.value(Cia301.IDENTITY, part + 1)

    def _switch(self, request: bytes, now: Instant) -> None:
        was_configuring = self.configuring
        if request[1] > 1:
            return
        self.configuring = request[1] == 1
        leaves = was_configuring and not self.configuring
        if leaves and self._station.node_id == UNCONFIGURED and self.pending_node_id != UNCONFIGURED:
            self._activate(now)

    def _select(self, request: bytes, _now: Instant) -> None:
        """Four messages in order, one for each part of the identity, all of which must match."""
        if self.configuring:
            return
        part = request[0] - Lss.SELECT_FIRST
        matches = _number(request) == self._identity(part) and (part == 0 or self._selected == part)
        self._selected = part + 1 if matches else 0
        if request[0] == Lss.SELECT_LAST and matches:
            self._selected = 0
            self.configuring = True
            self._answer(Lss.SELECTED)

    def _identify(self, request: bytes, _now: Instant) -> None:
        """Vendor-ID, product code, then ranges of revision and serial number: low, high, low, high."""
        step, number = request[0] - Lss.IDENTIFY_FIRST, _number(request)
        own = self._identity((0, 1, 2, 2, 3, 3)[step])
        fits = (own == number, own == number, own >= number, own <= number, own >= number, own <= number)[
            step
        ]
        in_order = step == 0 or self._identified == step
        self._identified = step + 1 if fits and in_order else 0
        if request[0] == Lss.IDENTIFY_LAST and self._identified:
            self._identified = 0
            self._answer(Lss.IDENTIFIED)

    @property
    def _has_no_node_id(self) -> bool:
        return self._station.node_id == UNCONFIGURED and self.pending_node_id == UNCONFIGURED

    def _identify_unconfigured(self, _request: bytes, _now: Instant) -> None:
        if self._has_no_node_id:
            self._answer(Lss.IDENTIFIED_UNCONFIGURED)

    def _fast_scan(self, request: bytes, _now: Instant) -> None:
        """Binary search by the master: the slaves whose part of the identity agrees down to a bit answer."""
        if self.configuring:
            if self.scan_answered_in_configuration:
                self._answer(Lss.IDENTIFIED)
            return
        if not self._has_no_node_id:
            return
        number, bit, part, following = _number(request), request[5], request[6], request[7]
        if bit == SCAN_RESET:
            self._scanned = 0
            self._answer(Lss.IDENTIFIED)
            return
        if bit > 31 or part > 3 or following > 3 or part != self._scanned:
            return
        if number >> bit != self._identity(part) >> bit:
            return
        if bit == 0:
            self._scanned = following
            # The last part has been confirmed when the master goes back to an earlier one.
            self.configuring = following < part
        self._answer(Lss.IDENTIFIED)

    def _configure_node_id(self, request: bytes, _now: Instant) -> None:
        node_id = request[1]
        good = 1 <= node_id <= NODE_ID_MAX or node_id == UNCONFIGURED
        if good:
            self.pending_node_id = node_id
        self._answer(Lss.CONFIGURE_NODE_ID, bytes([0 if good else 1]))

    def _configure_bit_timing(self, request: bytes, _now: Instant) -> None:
        good = request[1] == 0 and request[2] in BIT_RATES
        if good:
            self._pending_bit_rate = request[2]
        self._answer(Lss.CONFIGURE_BIT_TIMING, bytes([0 if good else 1]))

    def _activate_bit_timing(self, request: bytes, now: Instant) -> None:
        if self._pending_bit_rate is None:
            return
        self._switch_delay_ns = int.from_bytes(request[1:3], "little") * NS_PER_MS
        if self._switch_delay_ns:
            self._timer.start(Instant(now + self._switch_delay_ns))
        else:
            self._set_bit_rate(BIT_RATES[self._pending_bit_rate])

    def _on_switch_delay(self, now: Instant) -> None:
        """The first of the two delays is over, or the second."""
        station = self._station
        if station.cycle.mute:
            station.cycle.mute = False
            station.cycle.forget_frames()  # what could not be sent meanwhile
            return
        assert self._pending_bit_rate is not None, "the timer was started with one"
        self._set_bit_rate(BIT_RATES[self._pending_bit_rate])
        station.cycle.mute = True
        self._timer.start(Instant(now + self._switch_delay_ns))

    def _save(self, _request: bytes, _now: Instant) -> None:
        try:
            kept = self._store.load()
            kept[NODE_ID_KEY] = bytes([self.pending_node_id])
            if self._pending_bit_rate is not None:
                kept[BIT_RATE_KEY] = bytes([self._pending_bit_rate])
            self._store.save(kept)
        except (OSError, BenchError):
            self._answer(Lss.STORE, b"\x02")
        else:
            self._answer(Lss.STORE, b"\x00")

    def _inquire(self, request: bytes, _now: Instant) -> None:
        value = self._identity(request[0] - Lss.INQUIRE_FIRST)
        self._answer(request[0], value.to_bytes(4, "little"))

    def _inquire_node_id(self, _request: bytes, _now: Instant) -> None:
        self._answer(Lss.INQUIRE_NODE_ID, bytes([self._station.node_id]))


def _number(request: bytes) -> int:
    return int.from_bytes(request[1:5], "little")
