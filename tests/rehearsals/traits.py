"""What vendors' data sheets lack or have oddly: each trait changes the made-up sheet, and ends so or so.

``ends``: the reason, as a pattern, with which commissioning ends before anything moves; "" where the drive is
commissioned, if with steps left out or failed in ``without``.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.profile import Mode, supported_mode_bit
from tests.rehearsals.made_sheet import MadeSheet

_COMMUNICATION, _MAPPINGS = (0x1400, 0x1800), (0x1600, 0x1A00)
_TORQUE_PDO: Final[Mapping[int, tuple[int, ...]]] = {
    0x1600: (0x60400010, 0x60710010),
    0x1A00: (0x60410010, 0x60770010, 0x60640020),
    0x1A01: (0x606C0020,),
}
_SPEED_PDO: Final[Mapping[int, tuple[int, ...]]] = {
    0x1600: (0x60400010, 0x60FF0020),
    0x1A00: (0x60410010, 0x60770010),
    0x1A01: (0x606C0020, 0x60640020),
}
_STATE_PDO: Final[Mapping[int, tuple[int, ...]]] = {0x1600: (0x60400010,), 0x1A00: (0x60410010,)}


class Trait(NamedTuple):
    """One of them."""

    change: Callable[[MadeSheet], None]
    ends: str = ""
    without: frozenset[str] = frozenset()
    """Steps that are left out, or fail with a reason of their own."""
    mendable: bool = False
    """A commissioning that sets it right, or finds a way round, may do the drive all the same."""
    finds: str = ""
    """The faults that the drive has by it, as a pattern: every other one is invented."""
    faults: Mapping[str, Sequence[Mapping[str, object]]] = {}
    """What no sheet can say of it, as tables of a fault plan."""


def _lacks(*indices: int) -> Callable[[MadeSheet], None]:
    return lambda sheet: sheet.drop(*indices)


def _modes(*modes: Mode) -> Callable[[MadeSheet], None]:
    return lambda sheet: sheet.set(0x6502, default=sum(supported_mode_bit(mode) for mode in modes))


def _keeps_motor(vendor: int, objects: Mapping[int, Mapping[int, DataType]]) -> Callable[[MadeSheet], None]:
    def change(sheet: MadeSheet) -> None:
        sheet.by(vendor)
        for index, types in objects.items():
            sheet.add(index, types)

    return change


def _fixed(mappings: Mapping[int, tuple[int, ...]]) -> Callable[[MadeSheet], None]:
    def change(sheet: MadeSheet) -> None:
        for base in _MAPPINGS:
            for index in range(base, base + 4):
                sheet.map(index, mappings.get(index, ()), access="ro")
        sheet.every(1, (0x1800,), default="$NODEID+0x40000180")
        sheet.set(0x1801, 1, default="$NODEID+0x40000280")
        for index in (0x1802, 0x1803):
            sheet.set(index, 1, default="$NODEID+0xC0000380")

    return change


def _identity_in_device_info(sheet: MadeSheet) -> None:
    for sub in (1, 2, 3):
        sheet.set(0x1018, sub, default=" ")


def _frequency_converter(sheet: MadeSheet) -> None:
    """pp, vl and ip, without homing."""
    _modes(Mode.PROFILE_POSITION, Mode.VELOCITY, Mode.INTERPOLATED_POSITION)(sheet)
    sheet.set(0x6060, default=7)


def _positions_without_target(sheet: MadeSheet) -> None:
    """Profile position is offered, and is not there."""
    _modes(Mode.PROFILE_POSITION, Mode.HOMING)(sheet)
    sheet.drop(0x607A)


def _told_as_one(sheet: MadeSheet) -> None:
    sheet.drop(0x60A8, 0x60A9, 0x60AA, 0x6092, 0x6096)
    sheet.set(0x608F, 1, default=1)


def _told_as_one_beside_factors(factors: Mapping[int, tuple[int, int]]) -> Callable[[MadeSheet], None]:
    """608Fh is 1/1, as nobody set it; speeds and accelerations come by factors, numerator and divisor."""

    def change(sheet: MadeSheet) -> None:
        _told_as_one(sheet)
        sheet.drop(0x6090, 0x6096)
        for index, values in factors.items():
            sheet.add(index, {1: DataType.UNSIGNED32, 2: DataType.UNSIGNED32})
            for sub, value in enumerate(values, start=1):
                sheet.set(index, sub, default=value)

    return change


def _ramp_in(mode: Mode, index: int, **options: object) -> Callable[[MadeSheet], None]:
    """One mode beside homing, and options of the object of a ramp that it needs."""

    def change(sheet: MadeSheet) -> None:
        _modes(mode, Mode.HOMING)(sheet)
        sheet.set(index, **options)  # type: ignore[arg-type]

    return change


def _coarse_velocity_mode(sheet: MadeSheet) -> None:
    """A unit of 6042h is 10 r/min: the ramp of 604Ah is ten times as steep."""
    _modes(Mode.VELOCITY)(sheet)
    sheet.set(0x604C, 1, default=10)


def _slow_velocity_mode(sheet: MadeSheet) -> None:
    _modes(Mode.VELOCITY)(sheet)
    sheet.set(0x6048, 1, default=1, HighLimit=5)


def _encoder_of_2000(sheet: MadeSheet) -> None:
    sheet.drop(0x60A8, 0x60A9, 0x60AA, 0x6092, 0x6096)
    sheet.set(0x608F, 1, default=2000)


def _one_tpdo(sheet: MadeSheet) -> None:
    sheet.drop(0x1801, 0x1802, 0x1803, 0x1A01, 0x1A02, 0x1A03)


def _as_the_maker_has_it(index: int, data_type: DataType, **options: object) -> Callable[[MadeSheet], None]:
    """Sub-index 1 of an object of the maker's is what the options say."""

    def change(sheet: MadeSheet) -> None:
        sheet.drop(index)
        sheet.add(index, {1: data_type})
        sheet.set(index, 1, **options)  # type: ignore[arg-type]

    return change


def _slows_by_its_acceleration(sheet: MadeSheet) -> None:
    """Technosoft's iPOS: 6084h is not there, and a speed comes in increments per sample, 16.16."""
    sheet.by(0x1A3)
    sheet.set(0x1008, default="iPOS")
    _no_units(sheet)
    sheet.drop(0x6084, 0x607F)
    _modes(Mode.PROFILE_VELOCITY)(sheet)


def _no_units(sheet: MadeSheet) -> None:
    sheet.drop(0x608F, 0x6090, 0x6091, 0x6092, 0x6096, 0x60A8, 0x60A9, 0x60AA, 0x6075, 0x6076)


def _not_mappable(*indices: int) -> Callable[[MadeSheet], None]:
    def change(sheet: MadeSheet) -> None:
        for base in _MAPPINGS:
            for index in range(base, base + 4):
                sheet.map(index, [word for word in sheet.mapping(index) if word >> 16 not in indices])
        for index in indices:
            if sheet.has(index):
                sheet.set(index, PDOMapping=0)

    return change


def _makers_object_in_rpdo(sheet: MadeSheet) -> None:
    sheet.add(0x2200, {0: DataType.UNSIGNED16})
    sheet.set(0x2200, default=0x0155, PDOMapping=1)
    _fixed({**_TORQUE_PDO, 0x1600: (0x60400010, 0x22000010, 0x60710010)})(sheet)


def _no_event_timers(sheet: MadeSheet) -> None:
    for base in _COMMUNICATION:
        for index in range(base, base + 4):
            sheet.drop_sub(index, 5)


def _second_axis(sheet: MadeSheet) -> None:
    for index, data_type in (
        (0x6840, 6),
        (0x6841, 6),
        (0x6860, 2),
        (0x6861, 2),
        (0x6864, 4),
        (0x686C, 4),
        (0x6871, 3),
    ):
        sheet.add(index, {0: DataType(data_type)})


def _node_32(sheet: MadeSheet) -> None:
    for number, base in enumerate((0x200, 0x300, 0x400, 0x500)):
        sheet.set(0x1400 + number, 1, default=hex(base + 32))
        sheet.set(0x1800 + number, 1, default=hex(0xC000_0000 + base - 0x80 + 32))
    sheet.set(0x1014, default="0xA0")


def _as_it_is(_sheet: MadeSheet) -> None:
    """What is odd shows at the drive alone."""


def _refuses(abort: int, sub: int, *bases: int) -> Mapping[str, Sequence[Mapping[str, object]]]:
    """A write of that sub-index of each mapping is refused."""
    places = [f"{index:04X}:{sub}" for base in bases for index in range(base, base + 4)]
    return {"refused_mapping": [{"parameter": place, "abort": abort} for place in places]}


_NO_TORQUE: Final = frozenset({"torque_constant", "voltage_constant", "response", "suggest", "verify"})
_NO_CURRENT: Final = frozenset({"torque_constant"})
"""6078h finds no place beside the rest."""
_SLOPED: Final = frozenset({"delays", "suggest", "verify"})
"""In profile torque 6087h bounds the rise: no switch of the torque shows the delay of a command."""
_UNTOLD: Final = "does not tell its position unit; the nameplate's 65536 counts"
_UNSET: Final = "one position unit would be 6.283 rad; the nameplate's 65536 counts"
TRAITS: Final[dict[str, Trait]] = {
    "no 1018h": Trait(_lacks(0x1018)),
    "identity in [DeviceInfo]": Trait(_identity_in_device_info),
    "no 1008h": Trait(_lacks(0x1008)),
    "no 1013h": Trait(_lacks(0x1013)),
    "no 1016h": Trait(_lacks(0x1016), "no 1016h", mendable=True),
    "no 1017h": Trait(_lacks(0x1017), "1017h is missing", mendable=True),
    "no 1029h": Trait(_lacks(0x1029)),
    "profile 2065 in 1000h": Trait(lambda sheet: sheet.set(0x1000, default="0x00220811"), "0811h"),
    "of node 32": Trait(_node_32),
    "no 6007h": Trait(_lacks(0x6007)),
    "no 605Ah to 605Eh": Trait(_lacks(0x605A, 0x605B, 0x605C, 0x605D, 0x605E)),
    "no 6061h": Trait(_lacks(0x6061)),
    "6060h write-only": Trait(lambda sheet: sheet.set(0x6060, AccessType="wo")),
    "no 6502h": Trait(_lacks(0x6502)),
    "6502h without torque": Trait(
        _modes(Mode.PROFILE_POSITION, Mode.PROFILE_VELOCITY, Mode.HOMING, Mode.CYCLIC_SYNCHRONOUS_VELOCITY),
        without=_NO_TORQUE,
    ),
    "6502h without cyclic modes": Trait(
        _modes(Mode.PROFILE_POSITION, Mode.PROFILE_TORQUE, Mode.HOMING), without=_SLOPED
    ),
    "6502h with positions only": Trait(_modes(Mode.PROFILE_POSITION, Mode.HOMING), without=_NO_TORQUE),
    "6502h with positions only, no 607Ah": Trait(
        _positions_without_target, "profile position: 607Ah:00 is not in the dictionary"
    ),
    "6502h with velocity mode only": Trait(_modes(Mode.VELOCITY, Mode.HOMING), without=_NO_TORQUE),
    "6502h with interpolated position only": Trait(
        _modes(Mode.INTERPOLATED_POSITION, Mode.HOMING), without=_NO_TORQUE
    ),
    "6502h is 43h, 6060h 7": Trait(_frequency_converter, without=_NO_TORQUE),
    "6502h with homing only": Trait(
        _modes(Mode.HOMING), "none of the modes in which the bench could move it"
    ),
    "6060h refuses a mode of 6502h": Trait(
        lambda sheet: sheet.set(0x6060, default=8, HighLimit=9), without=_SLOPED
    ),
    "6060h holds 9 for good": Trait(
        lambda sheet: sheet.set(0x6060, default=9, AccessType="ro"), without=_NO_TORQUE
    ),
    "no 6071h": Trait(_lacks(0x6071, 0x60B2), without=_NO_TORQUE),
    "no 6077h": Trait(_lacks(0x6077), without=_NO_CURRENT),
    "no 6078h": Trait(_lacks(0x6078), without=_NO_CURRENT),
    "no 6076h": Trait(_lacks(0x6076)),
    "no 6079h": Trait(_lacks(0x6079), without=frozenset({"voltage_constant"})),
    "no 6075h": Trait(_lacks(0x6075)),
    "608Fh is 1/1": Trait(_told_as_one, "608Fh|beyond the limit", mendable=True),
    "608Fh is 1/1, 6094h": Trait(_told_as_one_beside_factors({0x6094: (1, 1)}), finds=_UNSET),
    "608Fh is 1/1, 6094h, 6097h": Trait(
        _told_as_one_beside_factors({0x6094: (10, 1), 0x6097: (100, 1)}), finds=_UNSET
    ),
    "608Fh is 1/1, 6096h": Trait(_told_as_one_beside_factors({0x6096: (60, 65536)}), finds=_UNSET),
    "608Fh is 1/1, 6090h, 6096h": Trait(
        _told_as_one_beside_factors({0x6090: (65536, 1), 0x6096: (60, 65536), 0x6097: (60, 65536)})
    ),
    "608Fh is 2000": Trait(_encoder_of_2000),
    "no position unit": Trait(
        _lacks(0x608F, 0x6090, 0x6092, 0x60A8, 0x60A9, 0x6096), finds="does not tell its position unit"
    ),
    "mappings fixed for torque": Trait(_fixed(_TORQUE_PDO), without=_NO_CURRENT),
    "mappings fixed for speed": Trait(_fixed(_SPEED_PDO), without=_NO_TORQUE),
    "mappings fixed, no values": Trait(
        _fixed(_STATE_PDO), "606Ch:00: the TPDOs have fixed mappings without it"
    ),
    "one TPDO": Trait(_one_tpdo, "the TPDOs have no room left for it"),
    "COB-IDs fixed": Trait(
        lambda sheet: sheet.every(1, _COMMUNICATION, AccessType="ro"), without=_NO_CURRENT
    ),
    "types fixed": Trait(lambda sheet: sheet.every(2, _COMMUNICATION, AccessType="ro"), without=_NO_CURRENT),
    "no 6085h": Trait(_lacks(0x6085)),
    "6085h is 0": Trait(lambda sheet: sheet.set(0x6085, default=0, LowLimit=0), "6085h", mendable=True),
    "6085h is tiny": Trait(lambda sheet: sheet.set(0x6085, default=1), "6085h", mendable=True),
    "6085h is 1000 at most": Trait(lambda sheet: sheet.set(0x6085, default=1, HighLimit=1000)),
    "6085h is steep": Trait(lambda sheet: sheet.set(0x6085, default=200_000)),
    "604Ah is steep": Trait(_coarse_velocity_mode, without=_NO_TORQUE),
    "no 6072h, 6073h, 6080h": Trait(_lacks(0x6072, 0x6073, 0x6080)),
    "6083h is 0": Trait(_ramp_in(Mode.PROFILE_VELOCITY, 0x6083, default=0, LowLimit=0), without=_NO_TORQUE),
    "6083h is tiny": Trait(_ramp_in(Mode.PROFILE_VELOCITY, 0x6083, default=1), without=_NO_TORQUE),
    "6083h is limited": Trait(
        _ramp_in(Mode.PROFILE_VELOCITY, 0x6083, default=10, HighLimit=2000),
        "too slow.*6083h = 2000 ",  # beside a unit that is finer than the sheet's
        _NO_TORQUE,
        mendable=True,
    ),
    "6083h is 1 at most": Trait(
        _ramp_in(Mode.PROFILE_VELOCITY, 0x6083, default=1, HighLimit=1),
        "too slow.*6083h = 1 ",
        _NO_TORQUE,
        mendable=True,
    ),
    "6081h is 2000 at most": Trait(
        _ramp_in(Mode.PROFILE_POSITION, 0x6081, default=10, HighLimit=2000),
        "too slow.*6081h = 2000 ",
        _NO_TORQUE,
        mendable=True,
    ),
    "6048h is 5 at most": Trait(
        _slow_velocity_mode,
        "too slow.*6048h = 5 ",
        _NO_TORQUE,
        mendable=True,
    ),
    "60C5h is 300 at most": Trait(
        _ramp_in(Mode.CYCLIC_SYNCHRONOUS_POSITION, 0x60C5, default=1, HighLimit=300), without=_NO_TORQUE
    ),
    "6084h is 0": Trait(_ramp_in(Mode.PROFILE_VELOCITY, 0x6084, default=0, LowLimit=0), without=_NO_TORQUE),
    "607Fh is 70 r/min": Trait(
        _ramp_in(Mode.PROFILE_VELOCITY, 0x607F, default=70_000), without=_NO_TORQUE | {"mechanics"}
    ),
    "no 6084h": Trait(_slows_by_its_acceleration, without=_NO_TORQUE, finds=_UNTOLD),
    "60C5h is tiny": Trait(_ramp_in(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, 0x60C5, default=1), without=_NO_TORQUE),
    "6087h is 0": Trait(_ramp_in(Mode.PROFILE_TORQUE, 0x6087, default=0, LowLimit=0), without=_SLOPED),
    "6087h is 10000 at most": Trait(
        _ramp_in(Mode.PROFILE_TORQUE, 0x6087, default=100, HighLimit=10000), without=_SLOPED
    ),
    "6087h is 1000 at most": Trait(
        _ramp_in(Mode.PROFILE_TORQUE, 0x6087, default=100, HighLimit=1000), without=_SLOPED | {"response"}
    ),
    "no 606Ch": Trait(_lacks(0x606C), "606Ch"),
    "no homing": Trait(_lacks(0x6098, 0x6099, 0x609A), without=frozenset({"turn"})),
    "motor by its maker's objects": Trait(
        _keeps_motor(
            0x29C, {0x2301: {0: DataType.UNSIGNED8}, 0x2701: dict.fromkeys(range(1, 7), DataType.UNSIGNED16)}
        )
    ),
    "motor by some of its maker's": Trait(_keeps_motor(0x22D2, {0x2003: {1: DataType.UNSIGNED8}})),
    "no 607Eh, 6065h, 607Dh": Trait(_lacks(0x607E, 0x6065, 0x607D)),
    "profile 0 in 1000h": Trait(lambda sheet: sheet.set(0x1000, default=0)),
    "2100h:01 a serial number": Trait(
        _as_the_maker_has_it(0x2100, DataType.UNSIGNED32, default=0x12345678, AccessType="ro")
    ),
    "2100h:01 a brake's time": Trait(_as_the_maker_has_it(0x2100, DataType.UNSIGNED16, default=100)),
    "no units": Trait(_no_units, finds=_UNTOLD),
    "606Ch not mappable": Trait(_not_mappable(0x606C), "606Ch"),
    "6077h not mappable": Trait(_not_mappable(0x6077), without=_NO_CURRENT),
    "6061h not mappable": Trait(_not_mappable(0x6061)),
    "a maker's object in a fixed RPDO": Trait(
        _makers_object_in_rpdo, "2200h", without=_NO_CURRENT, mendable=True
    ),
    "no event timers": Trait(_no_event_timers),
    "a second axis": Trait(_second_axis),
    "TPDO mappings refused at sub 1": Trait(
        _as_it_is, without=_NO_CURRENT, faults=_refuses(0x06040041, 1, 0x1A00)
    ),
    "mappings refused at sub 1": Trait(
        _as_it_is, without=_NO_CURRENT, faults=_refuses(0x06040041, 1, 0x1600, 0x1A00)
    ),
    "mappings refused at sub 0": Trait(
        _as_it_is, without=_NO_CURRENT, faults=_refuses(0x08000022, 0, 0x1600, 0x1A00)
    ),
    "6078h refused in a mapping": Trait(
        _as_it_is, without=_NO_CURRENT, faults={"refused_mapping": [{"mapped": "6078"}]}
    ),
    "EMCY 2310h again and again": Trait(
        _as_it_is, faults={"repeated_emergency": [{"code": 0x2310, "at_s": 0.5, "period_ms": 10.0}]}
    ),
}
