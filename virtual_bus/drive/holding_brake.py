"""The holding brake as the drive drives it, and its output in 60FEh.

    60FEh:1   physical outputs: bit 0 is 1 while the brake's coil has no current (CiA 402-2, "set brake")
    60FEh:2   bit mask: 1, and the output is what a master writes into 60FEh:1; 0, and the drive decides

The coil gets current with the power stage, and loses it at standstill once that is off. A drive that waits
for its brake holds the shaft at rest until the brake has opened, before it follows set-points, and until it
has closed, before it switches off.
"""

from enum import IntEnum
from typing import Final

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import Object
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.device.object_dictionary import Access, ObjectDictionary
from servobench.virtual_bus.drive.firmware import FirmwareParameters

_SET_BRAKE: Final = 1 << 0


class BrakeOrder(IntEnum):
    """Who decides about the coil's current; the core's numbers."""

    BY_STAGE = 0
    SET = 1
    RELEASED = 2


class HoldingBrake:
    """Set and released by the drive or its master."""

    def __init__(self, dictionary: ObjectDictionary, inner: InnerLoops, drive: FirmwareParameters) -> None:
        self.waits, self._close_s = drive.brake_waits, drive.brake_close_s
        self._inner = inner
        self._written = self._mask = 0
        if drive.brake_output:
            record = dictionary.add_record(Object.DIGITAL_OUTPUTS, "Digital outputs")
            for sub, name, read, write in (
                (1, "Physical outputs", self._outputs, self._write),
                (2, "Bit mask", lambda: self._mask, self._take_mask),
            ):
                record.add(
                    sub,
                    name,
                    DataType.UNSIGNED32,
                    Access.READ_WRITE,
                    mappable=True,
                    stored=False,
                    provider=read,
                    on_write=write,
                )

    def restart(self) -> None:
        """Power-on, or a reset of the node: the drive decides."""
        self._written = self._mask = 0
        self.decide()

    def closes(self) -> bool:
        """Set it while the power stage holds the shaft; whether that may go off."""
        if not self.waits or self._mask & _SET_BRAKE:
            return True
        self._inner.brake_order = BrakeOrder.SET
        return self._inner.brake_holds != 0.0

    def opens(self) -> bool:
        """The power stage holds the shaft; whether it may be moved."""
        return bool(self._mask & _SET_BRAKE) or self._inner.brake_holds == 0.0

    def catches(self, stop_rad_s2: float) -> bool:
        """Whether a stop from the present speed ends before the brake takes hold."""
        return abs(self._inner.speed_measured_rad_s) <= stop_rad_s2 * self._close_s

    def decide(self) -> None:
        """The power stage is switched, or the mask: nobody waits any more."""
        if not self._mask & _SET_BRAKE:
            self._inner.brake_order = BrakeOrder.BY_STAGE
        else:
            self._inner.brake_order = BrakeOrder.SET if self._written & _SET_BRAKE else BrakeOrder.RELEASED

    def _outputs(self) -> int:
        own = _SET_BRAKE if self._inner.braked else 0
        return self._written & ~_SET_BRAKE | own

    def _write(self, outputs: int) -> None:
        self._written = outputs  # the mask decides what of it counts
        self.decide()

    def _take_mask(self, mask: int) -> None:
        self._mask = mask
        self.decide()
