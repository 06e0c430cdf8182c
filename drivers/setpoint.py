"""Controlword and torque set-point of one drive, and the RPDOs that carry them."""

from collections.abc import Callable
from typing import Any

from drivers.network import CanopenNetwork
from drivers.objects402 import Object
from drivers.pdo import PdoMap, PdoPlan
from drivers.profile402 import Mode
from drivers.scaling import Scaling
from drivers.timebase import Instant

_TORQUE_RAW_MAX = 0x7FFF


class _Carrier:
    """One RPDO, its present values and where the two that change stand among them."""

    __slots__ = ("cob_id", "control_place", "pack", "torque_place", "values")

    def __init__(self, pdo: PdoMap) -> None:
        self.cob_id = pdo.cob_id
        self.pack: Callable[..., bytes] = pdo.codec().pack
        self.control_place = pdo.place_of(Object.CONTROLWORD)
        self.torque_place = pdo.place_of(Object.TARGET_TORQUE)
        self.values: list[Any] = [0] * len(pdo.entries)
        mode_place = pdo.place_of(Object.MODES_OF_OPERATION)
        if mode_place is not None:
            self.values[mode_place] = int(Mode.CYCLIC_SYNCHRONOUS_TORQUE)


class SetPoint:
    """What the drive is told each cycle. Every RPDO carries the one controlword that is in force.

    So a set-point never repeats an old controlword, in whatever number of RPDOs 0x6040 is mapped.
    """

    __slots__ = ("_carriers", "_control", "_network", "_per_nm", "_raw_max", "_torque", "clipped")

    def __init__(
        self, network: CanopenNetwork, plan: PdoPlan, scaling: Scaling, torque_max_nm: float | None
    ) -> None:
        self.clipped = 0
        """Set-points beyond the limit."""
        self._network = network
        self._per_nm = 1.0 / scaling.torque_nm
        limit = _TORQUE_RAW_MAX if torque_max_nm is None else int(torque_max_nm * self._per_nm + 1e-9)
        self._raw_max = min(limit, _TORQUE_RAW_MAX)
        self._carriers = [_Carrier(pdo) for pdo in plan.rpdos]
        self._control = [carrier for carrier in self._carriers if carrier.control_place is not None]
        torque = [carrier for carrier in self._carriers if carrier.torque_place is not None]
        if len(torque) != 1:
            raise ValueError(f"the PDO plan maps 6071h in {len(torque)} RPDOs, one is needed")
        self._torque = torque[0]

    def hold_torque(self, torque_nm: float) -> None:
        """Set the torque that the next frame carries, N m. Raises ValueError for what is no number."""
        raw = round(torque_nm * self._per_nm)
        limit = self._raw_max
        if not -limit <= raw <= limit:
            raw = limit if raw > 0 else -limit
            self.clipped += 1
        carrier = self._torque
        assert carrier.torque_place is not None
        carrier.values[carrier.torque_place] = raw

    def send_torque(self, torque_nm: float) -> Instant:
        """Set and send; returns the instant at which the bus was given the frame."""
        self.hold_torque(torque_nm)
        carrier = self._torque
        return self._network.link.send(carrier.cob_id, carrier.pack(*carrier.values))

    def send_controlword(self, controlword: int) -> None:
        """Put a controlword in force and send every RPDO that carries it."""
        self.hold_controlword(controlword)
        for carrier in self._control:
            self._network.link.send(carrier.cob_id, carrier.pack(*carrier.values))

    def hold_controlword(self, controlword: int) -> None:
        """Put a controlword in force without sending it: the next frame carries it."""
        for carrier in self._control:
            assert carrier.control_place is not None
            carrier.values[carrier.control_place] = controlword
