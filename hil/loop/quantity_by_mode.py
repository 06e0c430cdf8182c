"""Which quantity a drive takes as its set-point, by its mode of operation."""

from typing import Final

from servobench.hil.loop.scenario import Quantity

QUANTITY_BY_MODE: Final = {
    "cst": Quantity.TORQUE,
    "csv": Quantity.SPEED,
    "csp": Quantity.POSITION,
    "ip": Quantity.POSITION,
    "vl": Quantity.SPEED,
}
