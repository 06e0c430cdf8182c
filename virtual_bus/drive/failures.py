"""The faults of a drive while they last: EMCY, 1001h and 603Fh; the codes of those that it raises by itself
(CiA 301 table 26, CiA 402-1)."""

from typing import Final

from servobench.drivers.canopen.error_codes import HEARTBEAT_ERROR, ErrorRegister
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.device.canopen_device import RECOVERED_FROM_BUS_OFF
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.pdo_engine import PDO_DEADLINE
from servobench.virtual_bus.device.station import CommunicationLoss, DeviceServices
from servobench.virtual_bus.drive.power_stage import Trip

COMMUNICATION_ERROR: Final = 0x8100
LOSS_CODES: dict[CommunicationLoss, int] = {
    CommunicationLoss.HEARTBEAT: HEARTBEAT_ERROR,
    CommunicationLoss.LIFE_GUARDING: HEARTBEAT_ERROR,
    CommunicationLoss.RPDO_DEADLINE: PDO_DEADLINE,
    CommunicationLoss.BUS_OFF: RECOVERED_FROM_BUS_OFF,
}
"""Error code 603Fh by what was lost: that of the EMCY, which the device engine sends."""

FOLLOWING_ERROR: Final = 0x8611
"""60F4h was outside of 6065h for longer than 6066h."""


class Failures:
    """Failures since the last fault reset. 603Fh keeps the first."""

    def __init__(self, services: DeviceServices, error_code: Variable, inner: InnerLoops) -> None:
        self._services = services
        self._error_code = error_code
        self._inner = inner
        self._codes: set[int] = set()
        self._trip = Trip.NONE

    def forget(self) -> None:
        """Power-on: the device engine has forgotten them too."""
        self._codes.clear()
        self._forget_trip()

    def new_trip(self) -> Trip:
        """What the protection has found since it was asked last; NONE: nothing new."""
        if self._inner.trip == self._trip:
            return Trip.NONE
        self._trip = Trip(self._inner.trip)
        return self._trip

    def _forget_trip(self) -> None:
        """The power stage may be on again; what is still there trips once more."""
        self._inner.trip = self._trip = Trip.NONE
        self._inner.counts_missing = 0.0

    def add(self, code: int, register: ErrorRegister) -> None:
        """One more; it is reported."""
        self._codes.add(code)
        self._services.raise_error(code, register)

    def repeat(self, code: int, register: ErrorRegister) -> None:
        """Add a failure; report it again if it was active. See :meth:`add`."""
        self._codes.add(code)
        self._services.repeat_error(code, register)

    def show(self, code: int) -> None:
        """Put the cause of FAULT into 603Fh."""
        self._error_code.value = code

    def clear(self) -> None:
        """Fault reset: all of them are reported as gone."""
        self._forget_trip()
        if not self._error_code.value:
            return
        self._error_code.value = 0
        for code in sorted(self._codes):
            self._services.clear_error(code)
        self._codes.clear()

    @property
    def following(self) -> bool:
        """A following error is among them: bit 13 of the statusword goes on to say so."""
        return FOLLOWING_ERROR in self._codes
