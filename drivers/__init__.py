"""What is on the wire: CAN, CANopen, CiA 402. Knows no simulation."""

from drivers.compiled import use_fresh
from drivers.lean_can import spare_asammdf

use_fresh()
spare_asammdf()
