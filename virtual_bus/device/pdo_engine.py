"""All PDOs of a device: what a SYNC, a change of a value and a change of the NMT state do to them."""

from typing import Final

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import (
    MAPPING_OFFSET,
    PDOS_MAX,
    RPDO_COMMUNICATION,
    TPDO_COMMUNICATION,
)
from servobench.drivers.timebase import NEVER, NS_PER_MS, Instant
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.rpdo import ReceivePdo
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.device.tpdo import TransmitPdo

LOOK_NS: Final = NS_PER_MS
"""A mapped value that changes by time or motion is looked at no later than that after the last look."""
_OPERATIONAL: Final = NmtState.OPERATIONAL


class PdoEngine:
    """Makes a PDO of each communication parameter object that the dictionary holds (1400h.., 1800h..)."""

    def __init__(self, station: Station, emergency: EmergencyProducer) -> None:
        dictionary = station.dictionary
        self._station = station
        self.receive = [ReceivePdo(station, emergency, n) for n in _numbers(dictionary, RPDO_COMMUNICATION)]
        self.watching: list[TransmitPdo] = []
        """Those that are sent because of a change. What the device does costs nothing while it is empty."""
        self.look_at: Instant = NEVER
        """When to look for a change at the latest."""
        self.transmit = [
            TransmitPdo(station, self.watching, n) for n in _numbers(dictionary, TPDO_COMMUNICATION)
        ]

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

    def on_sync(self, counter: int) -> None:
        """Send earlier changes first; then sample, then actuate."""
        if self._station.state is not _OPERATIONAL:
            return
        if self.watching:
            self.look()
        for tpdo in self.transmit:
            if tpdo.follows_sync:
                tpdo.on_sync(counter)
        for rpdo in self.receive:
            if rpdo.waiting is not None:
                rpdo.actuate()

    def open_window(self, is_open: bool) -> None:
        """Synchronous window length, 1007h: outside of it synchronous RPDOs are discarded."""
        for rpdo in self.receive:
            rpdo.window_open = is_open

    def look(self) -> None:
        """Something may have changed: those that watch see for themselves."""
        runs = False
        for tpdo in self.watching:
            tpdo.look()
            runs = runs or tpdo.runs
        self.look_at = Instant(self._station.now + LOOK_NS) if runs else NEVER


def _numbers(dictionary: ObjectDictionary, first: int) -> list[int]:
    """PDOs whose COB-ID, transmission type and mapping are there; a vendor's file may lack some."""
    needed = ((first, 1), (first, 2), (first + MAPPING_OFFSET, 0))
    return [
        place + 1
        for place in range(PDOS_MAX)
        if all(dictionary.get(index + place, subindex) is not None for index, subindex in needed)
    ]
