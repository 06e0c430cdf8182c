"""What is on the wire: CAN, CANopen, CiA 402. Knows no simulation."""

from servobench.drivers.compiled import use_fresh
from servobench.drivers.lean_can import spare_asammdf

use_fresh()
spare_asammdf()
