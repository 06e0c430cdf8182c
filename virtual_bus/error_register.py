"""The error register of a CANopen device: what a plan of faults names, and what the device shows."""

from enum import IntFlag


class ErrorRegister(IntFlag):
    """Bits of object 1001h (CiA 301, 7.5.2.2)."""

    GENERIC = 0x01
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    DEVICE_PROFILE = 0x20
    MANUFACTURER = 0x80
