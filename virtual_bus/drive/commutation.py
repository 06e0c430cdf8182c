"""How a simulated drive commutates a motor that it has to be told of, and 60EAh.

    2120h:1   offset that is added to the encoder's electrical angle, 65536 a turn
    2120h:2   the motor's lines are swapped: 0 no, 1 yes
    2120h:3   pole pairs
    2120h:4   the electrical angle by which it commutates, 65536 a turn
    60EAh     commutation angle of cyclic synchronous torque mode with commutation angle (CiA 402-2), 65536 a
              turn: the current of a positive 6071h leads it by a quarter of a turn

A drive behind a maker's data sheet has the maker's objects in the place of 2120h, as far as a file in
drivers/vendors names them; what is not there stays as it was delivered.
"""

import math
from collections.abc import Callable
from typing import Any, Final

from servobench.design.motor import Commutation, PmsmParameters
from servobench.drivers.canopen.objects301 import Cia301, DataType
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.vendors.commutation_objects import CommutationObject, CommutationObjects
from servobench.drivers.vendors.families import commutation_for
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.device.object_dictionary import Access, Check, ObjectDictionary, Variable

COMMUTATION: Final = 0x2120
_TURN: Final = 65536


def told_commutation(
    dictionary: ObjectDictionary, inner: InnerLoops, motor: PmsmParameters, check: Check
) -> Callable[[], None]:
    """Return what a drive of ``motor`` does at power-on; its objects are made where the motor's commutation
    has to be told. ``check`` refuses a value while the drive is enabled."""
    if motor.commutation is None:
        return lambda: None
    return SimulatedCommutation(dictionary, inner, motor.commutation, motor.pole_pairs, check).take


class SimulatedCommutation:
    """Offset, order of the lines and pole pairs that the drive is set to, beside the true ones."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        inner: InnerLoops,
        true: Commutation,
        pole_pairs: int,
        check: Check,
    ) -> None:
        """``true``: the machine's; ``check`` refuses what is written too late."""
        self._dictionary, self._inner, self._true = dictionary, inner, true
        self._check = check
        self._delivered = true.pole_pairs_set or pole_pairs
        inner.commutation_active = 1
        record = dictionary.add_record(COMMUTATION, "Commutation")
        u8, u16 = DataType.UNSIGNED8, DataType.UNSIGNED16
        record.add(1, "Offset", u16)
        record.add(2, "Lines swapped", u8, high=1)
        record.add(3, "Pole pairs", u8, default=self._delivered, low=1)
        record.add(4, "Electrical angle", u16, Access.READ_ONLY, mappable=True)
        angle = Object.COMMUTATION_ANGLE
        dictionary.add(angle, angle.title, u16, mappable=True, stored=False, on_write=self._force)

    def take(self) -> None:
        """Power-on: the objects of this drive's maker are in force."""
        known = commutation_for(*self._identity()) or CommutationObjects(source="none")
        offset, swapped, pairs = known.offset, known.swapped, known.pole_pairs
        settings = [self._variable(each) for each in (offset, swapped, pairs)]

        def take(_value: Any = None) -> None:
            held = [None if variable is None else int(variable.value) for variable in settings]
            self._take(
                0.0 if offset is None or held[0] is None else math.tau * held[0] / offset.turn,
                bool(held[1]),
                held[2] or self._delivered,
            )

        for variable in settings:
            if variable is not None:
                variable.check, variable.on_write = self._check, take
        told = self._variable(known.angle)
        if told is not None and known.angle is not None:
            turn = known.angle.turn
            told.provider = lambda: round(self._angle_rad() / math.tau * turn) % turn
        take()

    def _take(self, offset_rad: float, swapped: bool, pole_pairs: int) -> None:
        inner = self._inner
        inner.commutation_ahead_rad = offset_rad - self._true.offset_rad
        inner.lines_mirrored = swapped != self._true.lines_swapped
        inner.commutation_pole_pairs = pole_pairs

    def _force(self, angle: int) -> None:
        self._inner.forced_rad = math.tau * angle / _TURN

    def _angle_rad(self) -> float:
        inner = self._inner
        within_turn = inner.count - inner.counts * math.floor(inner.count / inner.counts)
        encoder_rad = (within_turn + 0.5) * inner.rad_per_count
        return encoder_rad * inner.commutation_pole_pairs + inner.commutation_ahead_rad

    def _variable(self, known: CommutationObject | None) -> Variable | None:
        return None if known is None else self._dictionary.get(known.index, known.sub)

    def _identity(self) -> tuple[int, int, str]:
        vendor, product = (self._held(Cia301.IDENTITY, sub) or 0 for sub in (1, 2))
        name = self._held(Cia301.DEVICE_NAME, 0)
        text = name.split(b"\0", 1)[0].decode("latin-1").strip() if isinstance(name, bytes) else ""
        return int(vendor), int(product), text

    def _held(self, index: int, sub: int) -> Any:
        variable = self._dictionary.get(index, sub)
        return None if variable is None else variable.default
