"""Error codes of EMCY and of 0x603F in words: CiA 301 table 26, CiA 402-1 (error codes), makers' tables."""

from drivers.vendors.families import codes_of

_PHASES = {1: "L1", 2: "L2", 3: "L3"}
_WINDINGS = {1: "U", 2: "V", 3: "W"}

ERROR_TEXTS: dict[int, str] = {
    0x0000: "no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current, device input side",
    0x2110: "short circuit or earth leakage, input side",
    0x2120: "earth leakage, input side",
    **{0x2120 + n: f"earth leakage, phase {phase}" for n, phase in _PHASES.items()},
    0x2130: "short circuit, input side",
    0x2131: "short circuit between L1 and L2",
    0x2132: "short circuit between L2 and L3",
    0x2133: "short circuit between L3 and L1",
    0x2200: "current inside the device",
    **{0x2210 + n: f"current inside the device, no. {n}" for n in (1, 2)},
    0x2213: "over-current in the ramp",
    0x2214: "over-current in the sequence",
    0x2220: "continuous over-current inside the device",
    **{0x2220 + n: f"continuous over-current inside the device, no. {n}" for n in (1, 2)},
    0x2230: "short circuit or earth leakage inside the device",
    0x2240: "earth leakage inside the device",
    0x2250: "short circuit inside the device",
    0x2300: "current, device output side",
    0x2310: "continuous over-current",
    **{0x2310 + n: f"continuous over-current, no. {n}" for n in (1, 2)},
    0x2320: "short circuit or earth leakage",
    0x2330: "earth leakage",
    **{0x2330 + n: f"earth leakage, phase {phase}" for n, phase in _WINDINGS.items()},
    0x2340: "short circuit, output side",
    0x2341: "short circuit between U and V",
    0x2342: "short circuit between V and W",
    0x2343: "short circuit between W and U",
    0x2350: "load level fault, thermal state (I2t)",
    0x2351: "load level warning, thermal state (I2t)",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3110: "mains over-voltage",
    **{0x3110 + n: f"mains over-voltage, phase {phase}" for n, phase in _PHASES.items()},
    0x3120: "mains under-voltage",
    **{0x3120 + n: f"mains under-voltage, phase {phase}" for n, phase in _PHASES.items()},
    0x3130: "mains phase failure",
    **{0x3130 + n: f"mains phase {phase} missing" for n, phase in _PHASES.items()},
    0x3134: "mains phase sequence",
    0x3140: "mains frequency",
    0x3141: "mains frequency too high",
    0x3142: "mains frequency too low",
    0x3200: "voltage inside the device",
    0x3210: "DC link over-voltage",
    **{0x3210 + n: f"DC link over-voltage, no. {n}" for n in (1, 2)},
    0x3220: "DC link under-voltage",
    **{0x3220 + n: f"DC link under-voltage, no. {n}" for n in (1, 2)},
    0x3230: "load error",
    0x3300: "output voltage",
    0x3310: "output over-voltage",
    **{0x3310 + n: f"output over-voltage, phase {phase}" for n, phase in _WINDINGS.items()},
    0x3320: "armature circuit",
    0x3321: "armature circuit interrupted",
    0x3330: "field circuit",
    0x3331: "field circuit interrupted",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4110: "excess ambient temperature",
    0x4120: "ambient temperature too low",
    0x4130: "temperature of the supply air",
    0x4140: "temperature of the air outlet",
    0x4200: "device temperature",
    0x4210: "excess temperature of the device",
    0x4220: "device temperature too low",
    0x4300: "drive temperature",
    0x4310: "excess temperature of the drive",
    0x4320: "drive temperature too low",
    0x4400: "supply temperature",
    0x4410: "excess temperature of the supply",
    0x4420: "supply temperature too low",
    0x5000: "device hardware",
    0x5100: "supply",
    0x5110: "low supply voltage",
    0x5111: "supply of +/- 15 V low",
    0x5112: "supply of +24 V low",
    0x5113: "supply of +5 V low",
    **{0x5110 + n: f"low supply voltage, no. {n}" for n in range(4, 10)},
    0x5120: "supply of the intermediate circuit",
    0x5200: "control hardware",
    0x5210: "measurement circuit",
    0x5220: "computing circuit",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5410: "output stages",
    0x5420: "chopper",
    0x5430: "input stages",
    0x5440: "contacts",
    **{0x5440 + n: f"contact {n}" for n in range(1, 6)},
    0x5450: "fuses",
    **{0x5450 + n: f"fuse {n}" for n in range(1, 10)},
    0x5500: "data storage",
    0x5510: "working memory",
    0x5520: "program memory",
    0x5530: "non-volatile data memory",
    0x6000: "device software",
    0x6010: "software reset (watchdog)",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data record",
    **{0x6300 + n: f"data record no. {n}" for n in range(1, 16)},
    0x6310: "loss of parameters",
    0x6320: "parameter error",
    0x7000: "additional modules",
    0x7100: "power module",
    0x7110: "brake chopper",
    0x7111: "brake chopper failed",
    0x7112: "over-current in the brake chopper",
    0x7113: "protective circuit of the brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7123: "motor tilted",
    0x7200: "measurement module",
    0x7300: "sensor",
    0x7301: "tachometer fault",
    0x7302: "tachometer with wrong polarity",
    0x7303: "resolver 1",
    0x7304: "resolver 2",
    0x7305: "incremental sensor 1",
    0x7306: "incremental sensor 2",
    0x7307: "incremental sensor 3",
    0x7310: "speed sensor",
    0x7320: "position sensor",
    0x7400: "computation module",
    0x7500: "communication",
    0x7510: "serial interface 1",
    0x7520: "serial interface 2",
    0x7600: "data storage, external",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "transmit COB-ID collision",
    0x8200: "protocol error",
    0x8210: "PDO not processed because of its length",
    0x8220: "PDO length exceeded",
    0x8230: "destination of a DAM MPDO not available",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO time-out",
    0x8300: "torque control",
    0x8311: "excess torque",
    0x8312: "difficult start-up",
    0x8313: "standstill torque",
    0x8321: "insufficient torque",
    0x8331: "torque fault",
    0x8400: "velocity control",
    0x8500: "position control",
    0x8600: "positioning controller",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "synchronisation controller",
    0x8800: "winding controller",
    0x8900: "process data monitoring",
    0x8A00: "control",
    0x9000: "external error",
    0xF000: "additional functions",
    0xF001: "deceleration",
    0xF002: "sub-synchronous run",
    0xF003: "stroke operation",
    0xF004: "control of additional functions",
    0xFF00: "manufacturer-specific",
}
"""Error codes of 0x603F and of EMCY, CiA 402-1 (error codes) and CiA 301 table 26."""

_REGISTER_BITS = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "manufacturer",
)
"""0x1001, CiA 301 table 53, from bit 0 on."""


def error_text(code: int) -> str:
    """The text of an error code, or that of the narrowest class that holds it: 0x83FF is "torque control"."""
    for digits in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        text = ERROR_TEXTS.get(code & digits)
        if text is not None and (code & digits or not code):
            return text
    return "unknown error class"


def register_text(register: int) -> str:
    """The kinds of errors that 0x1001 tells: "current, voltage"; "none"."""
    kinds = [name for bit, name in enumerate(_REGISTER_BITS) if register >> bit & 1]
    return ", ".join(kinds) or "none"


# ---- vendors ----------------------------------------------------------------------------------------------


def fault_text(code: int, vendor: int = 0, device_name: str = "") -> str:
    """The vendor's text with the standard's class, or the standard's text alone."""
    standard = error_text(code)
    for table in codes_of(vendor, device_name):
        own = table.text(code)
        if own is not None:
            return own if own == standard or code in ERROR_TEXTS else f"{own}; {standard}"
    return standard


def history_text(entry: int, vendor: int = 0, device_name: str = "") -> str:
    """An entry of 0x1003 in words: the code in its low half, and what the maker tells in its high one."""
    text = fault_text(entry & 0xFFFF, vendor, device_name)
    for table in codes_of(vendor, device_name):
        cause = table.numbers.get(entry >> 24)
        if cause is not None and entry & 0xFFFF:
            return text if cause == text else f"{text} ({cause})"
    return text
