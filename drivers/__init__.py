"""What is on the wire: CAN, CANopen, CiA 402. Knows no simulation."""

from drivers.compiled import use_fresh

use_fresh()
