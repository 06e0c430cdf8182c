"""TIME consumer, 1012h: the master's calendar time for the application (CiA 301, 7.2.6, 7.5.2.15)."""

from drivers.canopen.nmt_states import NmtState
from drivers.timebase import Instant
from virtual_bus.device import cob_id
from virtual_bus.device.sdo_abort import AbortCode
from virtual_bus.device.station import Station
from virtual_bus.frame import Frame

CONSUMES = 1 << 31
PRODUCES = 1 << 30
MILLISECONDS_MASK = (1 << 28) - 1
TIME_OF_DAY_BYTES = 6


class TimeConsumer:
    """Takes TIME messages in PRE-OPERATIONAL and OPERATIONAL, if bit 31 of 1012h says so."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._listening: int | None = None
        variable = station.dictionary.get(0x1012)
        if variable is not None:
            variable.check = _check_cob_id
            variable.on_write = self._configure

    def reset_communication(self) -> None:
        """Take the COB-ID from the dictionary."""
        self._configure(self._station.value(0x1012))

    def _configure(self, value: int) -> None:
        if self._listening is not None:
            self._station.ignore(self._listening, self._on_time)
        self._listening = value & cob_id.CAN_ID if value & CONSUMES else None
        if self._listening is not None:
            self._station.listen(self._listening, self._on_time)

    def _on_time(self, frame: Frame, now: Instant) -> None:
        served = self._station.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
        if not served or len(frame.data) != TIME_OF_DAY_BYTES:
            return
        milliseconds = int.from_bytes(frame.data[:4], "little") & MILLISECONDS_MASK
        days = int.from_bytes(frame.data[4:6], "little")
        self._station.application.on_time(days, milliseconds, now)


def _check_cob_id(value: int) -> AbortCode | None:
    # 7.5.2.15: 06090030h for a producer where there is none, for bit 29, for a restricted CAN-ID.
    if value & (PRODUCES | cob_id.EXTENDED) or cob_id.restricted(value & cob_id.CAN_ID):
        return AbortCode.INVALID_VALUE
    return None
