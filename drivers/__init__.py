"""The wire side: CAN, CANopen, CiA 402. Contains no simulation."""

from servobench.drivers.compiled import use_fresh
from servobench.drivers.lean_can import spare_asammdf

use_fresh()
spare_asammdf()
