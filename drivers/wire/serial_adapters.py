"""USB serial ports of this machine, with what may be behind them. None is opened."""

import os
from typing import NamedTuple

from serial.tools import list_ports

KNOWN_USB = {
    (0x0403, 0xFFA8): "Lawicel CANUSB",
    (0x04D8, 0x000A): "USBtin, or another device with Microchip's CDC example",
    (0x0483, 0x5740): "STM32 virtual port, as of many SLCAN adapters",
    (0x16D0, 0x117E): "CANable with its slcan firmware",
    (0xAD50, 0x60C4): "CANable with its slcan firmware",
}
"""Vendor and product id -> what has them; ids of common converter chips tell nothing and are left out."""


class SerialPort(NamedTuple):
    """One serial port with a USB device behind it."""

    device: str
    description: str
    usb_id: str
    """``vvvv:pppp``"""
    serial_number: str
    hint: str
    """What is known to have this id; empty if nothing."""
    permitted: bool
    """This user may open it."""

    @property
    def spec(self) -> str:
        """What to hand to --bus, if an SLCAN adapter is behind it."""
        return f"slcan:{self.device}"


def serial_adapters() -> list[SerialPort]:
    """The USB serial ports, by name."""
    adapters = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        if port.vid is None or port.pid is None:
            continue
        adapters.append(
            SerialPort(
                port.device,
                port.description if port.description not in (None, "n/a") else "",
                f"{port.vid:04x}:{port.pid:04x}",
                port.serial_number or "",
                KNOWN_USB.get((port.vid, port.pid), ""),
                os.access(port.device, os.R_OK | os.W_OK),
            )
        )
    return adapters
