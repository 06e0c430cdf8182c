"""SDO abort codes (CiA 301, table 22) and the exception that carries one to the client."""

from enum import IntEnum


class AbortCode(IntEnum):
    """Why an SDO transfer was refused."""

    TOGGLE_BIT = 0x05030000
    TIMED_OUT = 0x05040000
    COMMAND_UNKNOWN = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE_NUMBER = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    PARAMETER_INCOMPATIBLE = 0x06040043
    INTERNAL_INCOMPATIBLE = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    NO_RESOURCE = 0x060A0023
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024

    @classmethod
    def _missing_(cls, value: object) -> "AbortCode | None":
        """A code that CiA 301 does not have: some makers' drives send such."""
        if not isinstance(value, int):
            return None
        code = int.__new__(cls, value)
        code._name_, code._value_ = "OF_A_MAKER", value
        return code


class SdoAbort(Exception):
    """An access to the dictionary that the standard forbids; becomes an abort on the bus, never a crash."""

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"SDO abort {code:#010x} {code.name}")
        self.code = code
