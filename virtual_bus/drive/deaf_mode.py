"""A mode of operation in which set-points arrive and are not followed."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from servobench.drivers.cia402.profile import Status
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary, Variable
from servobench.virtual_bus.drive.operation_mode import OperationMode

_POSITIONS: Final = ((0x607A, 0), (0x60C1, 1))
"""Target position, and the set-point of interpolated position."""
_OTHERS: Final = ((0x6042, 0), (0x6071, 0), (0x60B0, 0), (0x60B1, 0), (0x60B2, 0), (0x60FF, 0))
"""Targets of velocity and torque, and the offsets of all targets: at 0 the shaft is asked for nothing."""
_ACTUAL_POSITION: Final = 0x6064
_OWN_BITS: Final = 0x70
"""Bits 4 to 6 of the controlword: they belong to the mode (CiA 402-2, object 6040h)."""

SetPoints = list[tuple[Variable, int]]


def set_points(dictionary: ObjectDictionary, zero: bool) -> SetPoints:
    """Each set-point object of the drive with its present value, or where ``zero`` with that at which the
    shaft is asked for no torque, no speed and no other position than it has."""
    held: SetPoints = []
    for places, stays in ((_POSITIONS, int(dictionary.variable(_ACTUAL_POSITION).read())), (_OTHERS, 0)):
        for index, subindex in places:
            variable = dictionary.known(index, subindex)
            if variable is not None:
                held.append((variable, stays if zero else int(variable.value)))
    return held


class DeafMode(OperationMode):
    """Runs ``inner`` with the set-points ``held``, whatever the bus writes into the objects, which show it.

    Bits 4 to 6 of the controlword, by which a mode takes set-points, stay as they were. Halt and the commands
    of the state machine act.
    """

    def __init__(self, held: SetPoints, hides_bit_12: bool, inner: OperationMode) -> None:
        """``hides_bit_12``: bit 12 of the statusword is 0, in the cyclic modes "target ignored"."""
        super().__init__(inner.axis)
        self.inner = inner
        self.periodic = inner.periodic
        self.has_following_error = inner.has_following_error
        self._held = held
        self._shown = 0xFFFF & ~int(Status.MODE_12) if hides_bit_12 else 0xFFFF
        self._word = 0

    def begin(self, controlword: int) -> None:
        self._word = controlword
        with self._holding():
            self.inner.begin(controlword)

    def freeze(self, controlword: int) -> None:
        """``inner`` is followed, and turns deaf now."""
        self._word = controlword
        with self._holding():
            self._take_all()

    def thaw(self, controlword: int) -> None:
        """``inner`` goes on without this one, and with all that has been written meanwhile."""
        self._take_all()
        self.inner.receive(controlword)

    def receive(self, controlword: int) -> None:
        with self._holding():
            self.inner.receive(controlword & ~_OWN_BITS | self._word & _OWN_BITS)

    def run(self) -> None:
        with self._holding():
            self.inner.run()

    def status_bits(self) -> int:
        return self.inner.status_bits() & self._shown

    def slow_down_rad_s2(self) -> float:
        return self.inner.slow_down_rad_s2()

    def quick_stop_rad_s2(self) -> float:
        return self.inner.quick_stop_rad_s2()

    def _take_all(self) -> None:
        self.inner.take_torque()
        self.inner.take_velocity()
        self.inner.take_position()
        self.inner.take_data_record()

    @contextmanager
    def _holding(self) -> Iterator[None]:
        """The objects have the held values for as long as ``inner`` looks at them."""
        written = [(variable, variable.value) for variable, _ in self._held]
        for variable, value in self._held:
            variable.value = value
        try:
            yield
        finally:
            for variable, value in written:
                variable.value = value
