"""The device's numbers beside python-canopen's: its client was not written for our server."""

from canopen import lss
from canopen.sdo.exceptions import SdoAbortedError

from servobench.virtual_bus.device.lss_slave import BIT_RATES, Lss
from servobench.virtual_bus.device.sdo_abort import AbortCode


def test_abort_codes_are_those_of_python_canopen() -> None:
    assert {int(code) for code in AbortCode} == {*SdoAbortedError.CODES}
    words = {
        AbortCode.TOGGLE_BIT: "toggle bit",
        AbortCode.TIMED_OUT: "timeout",
        AbortCode.COMMAND_UNKNOWN: "unknown sdo command",
        AbortCode.BLOCK_SIZE: "block size",
        AbortCode.SEQUENCE_NUMBER: "sequence number",
        AbortCode.CRC: "crc",
        AbortCode.OUT_OF_MEMORY: "out of memory",
        AbortCode.UNSUPPORTED_ACCESS: "unsupported access",
        AbortCode.WRITE_ONLY: "read a write only",
        AbortCode.READ_ONLY: "write a read only",
        AbortCode.NO_OBJECT: "object does not exist",
        AbortCode.NOT_MAPPABLE: "cannot be mapped",
        AbortCode.PDO_LENGTH: "pdo length",
        AbortCode.PARAMETER_INCOMPATIBLE: "parameter incompatibility",
        AbortCode.INTERNAL_INCOMPATIBLE: "internal incompatibility",
        AbortCode.HARDWARE: "hardware",
        AbortCode.LENGTH: "length code do not match",
        AbortCode.TOO_LONG: "service parameter too high",
        AbortCode.TOO_SHORT: "service parameter too low",
        AbortCode.NO_SUBINDEX: "subindex",
        AbortCode.INVALID_VALUE: "value range",
        AbortCode.TOO_HIGH: "written too high",
        AbortCode.TOO_LOW: "written too low",
        AbortCode.MAXIMUM_BELOW_MINIMUM: "less than minimum",
        AbortCode.NO_RESOURCE: "resource",
        AbortCode.GENERAL: "general error",
        AbortCode.NOT_STORED: "or stored to the application",
        AbortCode.LOCAL_CONTROL: "local control",
        AbortCode.DEVICE_STATE: "device state",
        AbortCode.NO_DICTIONARY: "no object dictionary",
        AbortCode.NO_DATA: "no data",
    }
    assert {*words} == {*AbortCode}
    for code, text in words.items():
        assert text in SdoAbortedError.CODES[code].lower()


def test_layer_setting_services_are_those_of_python_canopen() -> None:
    assert {one.name: int(one) for one in Lss} == {
        "SWITCH_GLOBAL": lss.CS_SWITCH_STATE_GLOBAL,
        "CONFIGURE_NODE_ID": lss.CS_CONFIGURE_NODE_ID,
        "CONFIGURE_BIT_TIMING": lss.CS_CONFIGURE_BIT_TIMING,
        "ACTIVATE_BIT_TIMING": lss.CS_ACTIVATE_BIT_TIMING,
        "STORE": lss.CS_STORE_CONFIGURATION,
        "SELECT_FIRST": lss.CS_SWITCH_STATE_SELECTIVE_VENDOR_ID,
        "SELECT_LAST": lss.CS_SWITCH_STATE_SELECTIVE_SERIAL_NUMBER,
        "SELECTED": lss.CS_SWITCH_STATE_SELECTIVE_RESPONSE,
        "IDENTIFY_FIRST": lss.CS_IDENTIFY_REMOTE_SLAVE_VENDOR_ID,
        "IDENTIFY_LAST": lss.CS_IDENTIFY_REMOTE_SLAVE_SERIAL_NUMBER_HIGH,
        "IDENTIFY_UNCONFIGURED": lss.CS_IDENTIFY_NON_CONFIGURED_REMOTE_SLAVE,
        "IDENTIFIED": lss.CS_IDENTIFY_SLAVE,
        "IDENTIFIED_UNCONFIGURED": lss.CS_IDENTIFY_NON_CONFIGURED_SLAVE,
        "FAST_SCAN": lss.CS_FAST_SCAN,
        "INQUIRE_FIRST": lss.CS_INQUIRE_VENDOR_ID,
        "INQUIRE_LAST": lss.CS_INQUIRE_SERIAL_NUMBER,
        "INQUIRE_NODE_ID": lss.CS_INQUIRE_NODE_ID,
    }


def test_the_bit_timing_table_is_that_of_cia_305() -> None:
    in_kbit_s = {0: 1000, 1: 800, 2: 500, 3: 250, 4: 125, 6: 50, 7: 20, 8: 10}
    assert {index: bit_s // 1000 for index, bit_s in BIT_RATES.items()} == in_kbit_s
