"""An error frame as SocketCAN shows it: classes in the identifier, details as data (linux/can/error.h)."""

from typing import Final

import can

from servobench.drivers.wire.frame_port import ERROR_FLAG
from servobench.virtual_bus.bus.controller import PASSIVE_FROM, CanController, ErrorState
from servobench.virtual_bus.bus.disturbance import BusError, ErrorKind
from servobench.virtual_bus.frame import Frame

WARNING_FROM: Final = 96
"""Counters from here on are a warning (ISO 11898-1, error warning limit)."""

_CONTROLLER, _PROTOCOL, _ACKNOWLEDGE, _BUS_OFF, _BUS_ERROR, _COUNTERS = 0x04, 0x08, 0x20, 0x40, 0x80, 0x200
_RESTARTED: Final = 0x100
_TYPES = {ErrorKind.BIT: 0x01, ErrorKind.FORM: 0x02, ErrorKind.STUFF: 0x04}
_CRC_SEQUENCE, _ACK_SLOT = 0x08, 0x19
_LOCATIONS = {ErrorKind.CRC: _CRC_SEQUENCE, ErrorKind.ACKNOWLEDGEMENT: _ACK_SLOT}
_STATES = {ErrorState.ACTIVE: can.BusState.ACTIVE, ErrorState.PASSIVE: can.BusState.PASSIVE}


def told_bus_off(identifier: int) -> bool | None:
    """Return True if an error frame of that identifier reports bus-off, False for a recovery; None if
    neither."""
    if identifier & _BUS_OFF:
        return True
    return False if identifier & _RESTARTED else None


def bus_state(state: ErrorState) -> can.BusState:
    """The state in python-can's words, where ERROR is bus-off."""
    return _STATES.get(state, can.BusState.ERROR)


def error_frame_of(error: BusError, controller: CanController) -> Frame:
    """``error`` as it looks to the node of ``controller``; its identifier bears ERROR_FLAG."""
    transmit, receive = controller.transmit_errors, controller.receive_errors
    status = _level(transmit, 0x08, 0x20) | _level(receive, 0x04, 0x10)
    classes = _BUS_ERROR | _COUNTERS
    if error.kind is ErrorKind.ACKNOWLEDGEMENT:
        classes |= _ACKNOWLEDGE
    else:
        classes |= _PROTOCOL
    if status:
        classes |= _CONTROLLER
    if controller.state is ErrorState.BUS_OFF:
        classes |= _BUS_OFF
    data = bytes(
        (
            0,
            status,
            _TYPES.get(error.kind, 0),
            _LOCATIONS.get(error.kind, 0),
            0,
            0,
            min(transmit, 0xFF),
            min(receive, 0xFF),
        )
    )
    return Frame(ERROR_FLAG | classes, data)


def _level(counter: int, warning: int, passive: int) -> int:
    if counter >= PASSIVE_FROM:
        return passive
    return warning if counter >= WARNING_FROM else 0
