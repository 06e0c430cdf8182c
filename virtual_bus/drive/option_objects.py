"""The option codes of CiA 402-2: how the drive stops, and when."""

from collections.abc import Callable
from enum import IntEnum

from drivers.canopen.data_types import DataType
from drivers.cia402.objects402 import Object
from drivers.cia402.profile import (
    AbortConnectionOption,
    DisableOperationOption,
    FaultReactionOption,
    HaltOption,
    QuickStopOption,
    ShutdownOption,
)
from virtual_bus.device.object_dictionary import Access, ObjectDictionary
from virtual_bus.device.sdo_abort import AbortCode


def add_option_codes(dictionary: ObjectDictionary, abort_connection: AbortConnectionOption) -> None:
    """6007h and 605Ah..605Eh; each takes only what the drive can do."""
    for index, name, default in (
        (Object.ABORT_CONNECTION_OPTION, "Abort connection", abort_connection),
        (Object.QUICK_STOP_OPTION, "Quick stop", QuickStopOption.QUICK_STOP_RAMP),
        (Object.SHUTDOWN_OPTION, "Shutdown", ShutdownOption.DISABLE),
        (Object.DISABLE_OPERATION_OPTION, "Disable operation", DisableOperationOption.SLOW_DOWN_RAMP),
        (Object.HALT_OPTION, "Halt", HaltOption.SLOW_DOWN_RAMP),
        (Object.FAULT_REACTION_OPTION, "Fault reaction", FaultReactionOption.QUICK_STOP_RAMP),
    ):
        choices: type[IntEnum] = type(default)
        check = one_of(frozenset(int(choice) for choice in choices))
        dictionary.add(
            index,
            f"{name} option code",
            DataType.INTEGER16,
            Access.READ_WRITE,
            default=int(default),
            check=check,
        )


def one_of(values: frozenset[int]) -> Callable[[int], AbortCode | None]:
    """A check that refuses what is not in ``values``."""
    return lambda value: None if value in values else AbortCode.INVALID_VALUE
