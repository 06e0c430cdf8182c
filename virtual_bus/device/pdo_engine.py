"""All PDOs of a device, and what a change of the NMT state does to them."""

from typing import Final

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import (
    MAPPING_OFFSET,
    PDOS_MAX,
    RPDO_COMMUNICATION,
    TPDO_COMMUNICATION,
)
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.rpdo import ReceivePdo
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.device.tpdo import TransmitPdo

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
