"""Knowledge of a node's objects: its data sheet, its scales, by whoever knows them beforehand, and what the
bus has shown of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np
from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable
from numpy.typing import NDArray

from servobench.drivers.canopen.error_codes import fault_text, history_text, register_text
from servobench.drivers.canopen.objects301 import (
    MANDATORY,
    PDO_PARAMETERS,
    TPDO_COMMUNICATION,
    Cia301,
    is_mapping,
)
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, commands_in, state_of
from servobench.drivers.cia402.quirky_units import apply_quirks
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from servobench.drivers.errors import PeerFault
from servobench.drivers.rotation import RAD_PER_REVOLUTION, RAD_S_PER_RPM
from servobench.drivers.sheets.dictionary import held_by, load_dictionary
from servobench.drivers.sheets.eds.types import COB_ID_OBJECTS, VARIABLE, standard_object_type, standard_type
from servobench.drivers.vendors.families import known_families, quirks_for
from servobench.hil.reviewing.trace.object_value import ObjectValue, value_of

_RATED: Final = Object.MOTOR_RATED_TORQUE
_POSITIONS: Final = frozenset(
    {Object.POSITION_DEMAND_VALUE, Object.POSITION_ACTUAL_VALUE, Object.FOLLOWING_ERROR_WINDOW}
    | {Object.POSITION_WINDOW, Object.POSITION_OFFSET, Object.FOLLOWING_ERROR_ACTUAL_VALUE, 0x607A, 0x607C}
    | {Object.POSITION_RANGE_LIMIT, Object.SOFTWARE_POSITION_LIMIT}
)
_VELOCITIES: Final = frozenset({0x606B, 0x606C, 0x606D, 0x606F, 0x607F, 0x6081, 0x6082, 0x60B1, 0x60FF})
_UNSIGNED_SPEEDS: Final = frozenset({0x606D, 0x606F, 0x607F, 0x6081, 0x6082})
"""Limits and windows, which have no direction."""
_ACCELERATIONS: Final = frozenset({0x6083, 0x6084, 0x6085, 0x609A, 0x60C5, 0x60C6})
_TORQUES: Final = frozenset({0x6071, 0x6072, 0x6074, 0x6077, 0x60B2})
_TORQUE_LIMITS: Final = frozenset({0x6072})
_CURRENTS: Final = frozenset({0x6073, 0x6078})
_FIXED: Final = {
    0x6075: (1e-3, "A"),
    0x6079: (1e-3, "V"),
    0x6080: (RAD_S_PER_RPM, "rad/s"),
}
"""Units that the standard fixes: mA, mV, r/min."""
_RATED_UNIT_NM: Final = 1e-3
"""Unit of 6076h by the standard; makers have others."""
_MODES: Final = frozenset({Object.MODES_OF_OPERATION, Object.MODES_OF_OPERATION_DISPLAY})
_WORDED: Final = _MODES | {
    Object.STATUSWORD, Object.CONTROLWORD, Object.ERROR_CODE, Cia301.ERROR_REGISTER, Cia301.ERROR_HISTORY
}  # fmt: skip
"""Objects of which :meth:`NodeObjects.number` tells the meaning."""
_UNSURE_VELOCITY: Final = "position unit per second"
"""How the scaling's source begins where the drive has no velocity unit, or was not asked for it."""
_TITLES: Final = {int(entry): entry.title for entry in (*Cia301, *Object)}
_IDENTITY: Final = {1: "Vendor-ID", 2: "Product code", 3: "Revision number", 4: "Serial number"}
_PDO: Final = {
    1: "COB-ID",
    2: "transmission type",
    3: "inhibit time",
    5: "event timer",
    6: "SYNC start value",
}
_COUNTED: Final = frozenset({Cia301.ERROR_HISTORY, Cia301.CONSUMER_HEARTBEAT_TIME, Cia301.IDENTITY})
"""Sub-index 0 of these is a count."""
_WORDS_OF_BITS: Final[frozenset[int]] = frozenset(
    {*MANDATORY, *_COUNTED, *COB_ID_OBJECTS, Cia301.STATUS_REGISTER}
    | {Object.CONTROLWORD, Object.STATUSWORD, Object.ERROR_CODE, Object.DIGITAL_INPUTS}
    | {Object.SI_UNIT_POSITION, Object.SI_UNIT_VELOCITY, Object.SI_UNIT_ACCELERATION, Object.SI_UNIT_JERK}
    | {Object.SUPPORTED_DRIVE_MODES}
)


Numbers = TypeVar("Numbers", float, NDArray[np.float64])


class _Units(NamedTuple):
    """Factors, and which of them are known."""

    scaling: Scaling
    motion: bool
    velocity: bool
    torque: bool
    rated_unit_nm: float
    """Unit of 6076h."""


class NodeObjects:
    """Names, types, units and last values of one node's objects."""

    def __init__(self, override: ScaleOverride | None = None) -> None:
        """``override``: factors and signs that a commissioning found."""
        self.sheet: ObjectDictionary | None = None
        self._override = override or ScaleOverride()
        self._told: dict[tuple[int, int], int] = {}
        self._lacking: set[tuple[int, int]] = set()
        self._device_name = ""
        self._units: _Units | None = None
        """None: something has been told since."""
        self._names: dict[tuple[int, int], str] = {}

    def use_sheet(self, sheet: ObjectDictionary) -> None:
        """This is the node's data sheet."""
        self.sheet, self._units = sheet, None
        self._names.clear()

    def take(self, index: int, sub: int, data: bytes) -> None:
        """The node holds ``data`` there: it told so, or confirmed it."""
        if index == Cia301.DEVICE_NAME:
            self._device_name = str(value_of(data, 0x09) or "")
            self._units = None
        if len(data) > 8:
            return
        if index in _NEEDED or index in PDO_PARAMETERS:
            value = value_of(data, self.data_type(index, sub))
            if isinstance(value, int):
                self._told[index, sub] = value
                if index in _NEEDED:
                    self._units = None
        self._lacking.discard((index, sub))

    def lacks(self, index: int, sub: int) -> None:
        """The node has no such object."""
        if index in _NEEDED:
            self._lacking.add((index, sub))
            self._units = None

    def held(self, index: int, sub: int) -> int | None:
        """The value that was told last, else that of the data sheet; None if neither has it."""
        told = self._told.get((index, sub))
        if told is not None or (index, sub) in self._lacking:
            return told
        value = held_by(self._variable(index, sub))
        return value if isinstance(value, int) else None

    def pdo_numbers(self, base: int) -> Iterator[int]:
        """Numbers of the PDOs whose parameters are known; ``base``: 1400h or 1800h."""
        listed = {index for index, _ in self._told}
        listed |= set(self.sheet) if self.sheet is not None else set()
        yield from sorted(
            {index - base + 1 for index in listed if base <= index < base + 0x200}
            | {index - base - 0x1FF for index in listed if base + 0x200 <= index < base + 0x400}
        )

    @property
    def make(self) -> tuple[int, str]:
        """Vendor-ID and device name, as far as they are known."""
        return self.held(Cia301.IDENTITY, 1) or 0, self._device_name

    def value(self, index: int, sub: int, data: bytes) -> ObjectValue:
        """``data`` of an object in words."""
        return self.number(index, sub, value_of(data, self.data_type(index, sub)))

    def number(self, index: int, sub: int, raw: int | float | str | None) -> ObjectValue:
        """A number that is typed already."""
        name = self._names.get((index, sub))
        if name is None:
            name = self._names[index, sub] = self._name(index, sub)
        si = unit = None
        if isinstance(raw, int | float):
            si, unit = self.in_si(index, sub, raw)
        words = self._words(index, sub, raw) if isinstance(raw, int) else ""
        return ObjectValue(index, sub, name, raw, si, unit or "", words, _is_word_of_bits(index, sub))

    def _name(self, index: int, sub: int) -> str:
        variable = self._variable(index, sub)
        if variable is None:
            return _standard_name(index, sub)
        parent = variable.parent
        if isinstance(parent, ODArray | ODRecord) and parent.name != variable.name:
            return f"{parent.name}, {variable.name}"
        return str(variable.name)

    def data_type(self, index: int, sub: int) -> int | None:
        """By the data sheet, else by the standard."""
        variable = self._variable(index, sub)
        if variable is not None and variable.data_type is not None:
            return int(variable.data_type)
        return _type_by_standard(index, sub)

    def _variable(self, index: int, sub: int) -> ODVariable | None:
        if self.sheet is None or index not in self.sheet:
            return None
        entry = self.sheet[index]
        if isinstance(entry, ODVariable):
            return entry if sub == 0 else None
        return entry.subindices.get(sub)

    @staticmethod
    def has_words(index: int) -> bool:
        """Return True if numbers of an object have a meaning in words."""
        return index in _WORDED

    def _words(self, index: int, sub: int, raw: int) -> str:
        if index == Object.STATUSWORD:
            state = state_of(raw)
            return "no state of CiA 402" if state is None else state.value
        if index == Object.CONTROLWORD:
            reset = ("fault reset",) if raw & 0x80 else ()
            return " or ".join(command.value for command in commands_in(raw)) or ", ".join(reset)
        if index in _MODES:
            return Mode(raw).title if raw in Mode.__members__.values() else "mode of the maker"
        if index == Object.ERROR_CODE:
            return fault_text(raw, *self.make)
        if index == Cia301.ERROR_REGISTER:
            return register_text(raw)
        if index == Cia301.ERROR_HISTORY and sub:
            return history_text(raw, *self.make)
        return ""

    def in_si(self, index: int, sub: int, raw: Numbers) -> tuple[Numbers | None, str]:
        """Return a raw number, or many, in SI with the unit; None where nobody has told how the drive
        counts."""
        if index in _FIXED:
            factor, unit = _FIXED[index]
            return raw * factor, unit
        if index in (Object.POSITION_RANGE_LIMIT, Object.SOFTWARE_POSITION_LIMIT) and not sub:
            return None, ""
        units = self._known_units()
        scaling = units.scaling
        if index == _RATED:
            return raw * units.rated_unit_nm, "N m"
        if index in _POSITIONS and units.motion:
            return raw * scaling.position_rad, "rad"
        if index in _VELOCITIES and units.velocity:
            sign = 1.0 if index in _UNSIGNED_SPEEDS else scaling.velocity_sign
            return raw * sign * scaling.velocity_rad_s, "rad/s"
        if index in _ACCELERATIONS and units.velocity:
            return raw * scaling.acceleration_rad_s2, "rad/s^2"
        if index in _TORQUES and units.torque:
            sign = 1.0 if index in _TORQUE_LIMITS else scaling.torque_sign
            return raw * sign * scaling.torque_nm, "N m"
        if index in _CURRENTS and scaling.rated_current_a is not None:
            return raw * scaling.rated_current_a / 1000.0, "A"
        return None, ""

    def _known_units(self) -> _Units:
        if self._units is None:
            self._units = self._find_units()
        return self._units

    def _find_units(self) -> _Units:
        """Return the units found so far; a part that is unknown does not hide the other."""
        values = {key: self.held(*key) for key in FACTOR_OBJECTS}
        vendor, name = self.make
        quirks = quirks_for(vendor, self.held(Cia301.IDENTITY, 2) or 0, name) if vendor else ()
        applied = apply_quirks(quirks, values, self._override, self.held)
        given = applied.override
        torque = bool(applied.values.get((_RATED, 0)) or given.rated_torque_nm)
        trial = given if torque else ScaleOverride(
            given.position_rad, given.velocity_rad_s, given.acceleration_rad_s2, 1.0, given.velocity_sign
        )  # fmt: skip
        try:
            scaling, motion = scaling_from(applied.values, trial), True
        except PeerFault:
            unit = RAD_PER_REVOLUTION
            nothing = ScaleOverride(unit, unit, unit, trial.rated_torque_nm, torque_sign=given.torque_sign)
            scaling, motion = scaling_from(applied.values, nothing), False
        asked = (Object.SI_UNIT_VELOCITY, 0) in self._lacking or self.sheet is not None
        guessed = scaling.sources["velocity"].startswith(_UNSURE_VELOCITY) and not asked
        rated_unit_nm = next(
            (each.rated_torque_nm for _, each in quirks if each.rated_torque_nm), _RATED_UNIT_NM
        )
        return _Units(scaling, motion, motion and not guessed, torque, rated_unit_nm)


_NEEDED: Final = frozenset(
    {Cia301.IDENTITY, *(index for index, _ in FACTOR_OBJECTS)}
    | {quirk.increments_index for family in known_families() for quirk in family.quirks}
)
"""Objects on which the units rest."""


@cache
def _standard_name(index: int, sub: int) -> str:
    """``Target torque``, ``TPDO1 mapping, object 2``; empty if no standard has it."""
    if index == Cia301.IDENTITY and sub in _IDENTITY:
        return _IDENTITY[sub]
    if index in PDO_PARAMETERS:
        pdo = f"{'R' if index < TPDO_COMMUNICATION else 'T'}PDO{(index & 0x1FF) + 1}"
        part = f"object {sub}" if sub else "number of objects"
        return f"{pdo} " + (
            f"mapping, {part}" if is_mapping(index) else _PDO.get(sub, "communication parameter")
        )
    name = _TITLES.get(index, "")
    return f"{name}, {sub}" if name and sub else name


@cache
def _type_by_standard(index: int, sub: int) -> int | None:
    """The data type of an object by CiA 301 and CiA 402; None if they do not say."""
    simple = sub == 0 and standard_object_type(index) == VARIABLE
    return standard_type(index, None if simple else sub)


@cache
def _is_word_of_bits(index: int, sub: int) -> bool:
    """Shown in hexadecimal: an identifier, a unit word, a word of bits."""
    if index in PDO_PARAMETERS:
        return sub > 0 if is_mapping(index) else sub == 1
    return index in _WORDS_OF_BITS and (sub > 0 or index not in _COUNTED)


NodeKey = tuple[str, int]
"""Channel, empty for every one, and node-ID."""
_VENDOR: Final = 1
_PRODUCT: Final = 2


class SheetFile(NamedTuple):
    """A data sheet, and the node that it is for."""

    path: Path
    node: int | None = None
    """None: a DCF's own node; of an EDS every node that has no sheet of its own."""
    channel: str = ""
    """Empty: on every one."""


class _Candidate(NamedTuple):
    path: Path
    vendor: int | None
    product: int | None


class KnownNodes:
    """Gives each node that appears its data sheet and scale."""

    def __init__(
        self, sheets: Sequence[SheetFile] = (), overrides: Mapping[NodeKey, ScaleOverride] | None = None
    ) -> None:
        """Raises BadInput for a data sheet that cannot be read."""
        self._overrides = dict(overrides or {})
        self._assigned: dict[NodeKey, Path] = {}
        self._candidates: list[_Candidate] = []
        for file in sheets:
            loaded = load_dictionary(file.path, file.node)
            node = loaded.dictionary.node_id
            if node is not None:
                self._assigned.setdefault((file.channel, node), file.path)
            else:
                device = loaded.device
                self._candidates.append(_Candidate(file.path, device.vendor_number, device.product_number))

    def objects(self, channel: str, node: int) -> NodeObjects:
        """Return the objects of a node; one not seen before is added."""
        override = self._overrides.get((channel, node)) or self._overrides.get(("", node))
        objects = NodeObjects(override)
        path = self._assigned.get((channel, node)) or self._assigned.get(("", node))
        if path is None and len(self._candidates) == 1:
            path = self._candidates[0].path
        if path is not None:
            objects.use_sheet(load_dictionary(path, node).dictionary)
        return objects

    def identified(self, objects: NodeObjects, node: int) -> bool:
        """Return True if the node, which has sent its identity 1018h, has a sheet now and had none before."""
        if objects.sheet is not None:
            return False
        identity = objects.held(Cia301.IDENTITY, _VENDOR), objects.held(Cia301.IDENTITY, _PRODUCT)
        for candidate in self._candidates:
            if identity == (candidate.vendor, candidate.product):
                objects.use_sheet(load_dictionary(candidate.path, node).dictionary)
                return True
        return False
