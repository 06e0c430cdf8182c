"""Judges by its dictionary whether a drive can serve a bench: identity, modes, PDOs, and missing objects.

An obstacle is the lack of an essential object. Everything else degrades by itself, with a note on the loss:
of real drive dictionaries one in four defines 603Fh, one in three 6091h.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import canopen.objectdictionary as od

from servobench.drivers.canopen.objects301 import FIRST_OBJECT, Cia301, is_mapping
from servobench.drivers.canopen.pdo import BITS_MAX, key_of, mapping_text
from servobench.drivers.canopen.pdo_capability import PdoCapability, PdoSlot
from servobench.drivers.cia402.judgement import Judgement, ModeFitness, ToldDrive, judge, offered
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, run_words
from servobench.drivers.cia402.velocity_mode import RAMPS, SPEEDS
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import LoadedDictionary, held, held_by, held_number, told_identity
from servobench.drivers.vendors.families import stamp_for
from servobench.drivers.vendors.stamps import StampProfile

_NAMED_MAX = 4
"""Contradictions of a kind that are listed one by one; the others are counted."""
AXIS_STEP = 0x800
"""CiA 402-2: offset of the objects of the next axis."""
_TORQUE_MODES = (Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.PROFILE_TORQUE)
_READ_ONLY = ("ro", "const")
_RAMP_BOUNDLESS = (1 << 31) - 1
"""A greatest value that is only the end of a type, of 31 or 32 bits, says nothing about a drive."""
MODES_TOLD = "6502h"
"""Source of the modes, if they need not be tried."""


@dataclass(frozen=True, slots=True)
class Lack:
    """A recommended object that a dictionary does not define."""

    index: int
    name: str
    consequence: str

    def __str__(self) -> str:
        return f"{self.index:04X}h {self.name}: {self.consequence}"


class FileIdentity(NamedTuple):
    """The device of a dictionary; None and empty where it is silent."""

    vendor_name: str
    product_name: str
    order_code: str
    vendor: int | None
    product: int | None
    revision: int | None
    device_name: str
    device_type: int | None

    @property
    def profile(self) -> int | None:
        """The number of its device profile; None without 1000h."""
        return None if self.device_type is None else self.device_type & 0xFFFF

    @property
    def stamp(self) -> StampProfile:
        """How drives of that make stamp their samples."""
        return stamp_for(self.vendor or 0, self.product or 0, self.device_name or self.product_name)


@dataclass(frozen=True, slots=True)
class Fitness:
    """A dictionary's fitness for a bench."""

    identity: FileIdentity
    profile: int | None
    axes: int
    """Axes that have their own controlword."""
    modes: tuple[Mode, ...]
    modes_told_by: str
    """"6502h", or the basis of the conclusion."""
    usable: tuple[ModeFitness, ...]
    """The modes in which the bench could command it, the best first."""
    pdos: tuple[PdoSlot, ...]
    lacks: tuple[Lack, ...]
    obstacles: tuple[str, ...]
    conditions: tuple[str, ...]
    """Conditions that the user must accept before it can be commissioned or run."""
    remarks: tuple[str, ...]

    @property
    def serves(self) -> bool:
        """True if it can serve a bench."""
        return not self.obstacles

    @property
    def best(self) -> ModeFitness | None:
        """The mode to use."""
        return next((mode for mode in self.usable if mode.plan is not None), None)


RECOMMENDED = (
    (0x1003, "pre-defined error field", "no history of faults"),
    (0x1005, "COB-ID SYNC", "its PDOs cannot follow the SYNC"),
    (0x1008, "manufacturer device name", "it does not say its name"),
    (0x1010, "store parameters", "what is set is lost when it is switched off"),
    (0x1011, "restore default parameters", "factory settings cannot be recalled"),
    (0x1013, "high resolution time stamp", "samples are dated by their arrival"),
    (0x1014, "COB-ID EMCY", "it may send no emergencies"),
    (0x1016, "consumer heartbeat time", "it does not notice by itself that the host is gone"),
    (0x1017, "producer heartbeat time", "the host does not notice by itself that it is gone"),
    (0x6007, "abort connection option code", "what it does when the host is gone is its own choice"),
    (0x603F, "error code", "the cause of a fault comes with the EMCY only"),
    (0x605A, "quick stop option code", "how it stops is its own choice"),
    (0x605E, "fault reaction option code", "how it stops in a fault is its own choice"),
    (0x6061, "modes of operation display", "a change of mode cannot be verified"),
    (0x6064, "position actual value", "no position"),
    (0x6065, "following error window", "it does not watch its following error"),
    (0x606C, "velocity actual value", "no velocity"),
    (0x6071, "target torque", "no torque set-point"),
    (0x6072, "max torque", "its torque limit cannot be set"),
    (0x6075, "motor rated current", "currents have no unit"),
    (0x6076, "motor rated torque", "torques have no unit: give rated_torque_nm"),
    (0x6077, "torque actual value", "no torque feedback"),
    (0x607D, "software position limit", "no position limit in the drive"),
    (0x6080, "max motor speed", "its speed limit cannot be set"),
    (0x6085, "quick stop deceleration", "its quick stop ramp cannot be set"),
    (0x608F, "position encoder resolution", "position units need 60A8h or an override"),
    (0x6091, "gear ratio", "no gear in the units"),
    (0x60A8, "SI unit position", "position units are concluded from the factors"),
    (0x60A9, "SI unit velocity", "velocity units are concluded from the factors"),
    (0x6502, "supported drive modes", "its modes are concluded from its objects"),
)
"""Objects that a bench uses, and the loss without each."""


def assess(loaded: LoadedDictionary, node_id: int, asked: Sequence[Mode]) -> Fitness:
    """Judge a dictionary, loaded for ``node_id``; ``asked``: modes in which a bench can command a drive, the
    best first."""
    dictionary, identity, told = loaded.dictionary, _identity(loaded), told_by_sheet(loaded)
    judgement = judge(told, node_id, asked)
    by = MODES_TOLD if judgement.modes_told else "their set-point objects, to be tried (6502h gives no value)"
    return Fitness(
        identity=identity,
        profile=identity.profile,
        axes=_axes(dictionary),
        modes=tuple(mode for mode in Mode if mode and offered(told, mode)),
        modes_told_by=by,
        usable=judgement.modes,
        pdos=told.capability.slots,
        lacks=tuple(Lack(*known) for known in RECOMMENDED if _place(known[0], told) not in dictionary),
        obstacles=judgement.obstacles,
        conditions=judgement.conditions,
        remarks=(*_remarks(dictionary, identity.profile, judgement), *doubts(dictionary, told.capability)),
    )


def _place(index: int, told: ToldDrive) -> int:
    """Return the maker's equivalent of the standard object at ``index``."""
    return told.stamp[0] if index == Cia301.HIGH_RESOLUTION_TIME_STAMP else index


def told_by_sheet(loaded: LoadedDictionary) -> ToldDrive:
    """Collect the facts about a drive from its data sheet."""
    dictionary = loaded.dictionary
    mode = dictionary.get(Object.MODES_OF_OPERATION)
    limits: tuple[int | None, int | None] = (None, None)
    held_mode = None
    if isinstance(mode, od.ODVariable):
        limits = (mode.min, mode.max)
        held_mode = held_by(mode) if mode.access_type in _READ_ONLY else None
    return ToldDrive(
        held_number(dictionary, Cia301.DEVICE_TYPE),
        held_number(dictionary, Object.SUPPORTED_DRIVE_MODES),
        lambda index: index in dictionary,
        limits,
        held_mode,
        capability_of(loaded),
        _identity(loaded).stamp.if_there(lambda index, _sub: index if index in dictionary else None).key,
    )


def _identity(loaded: LoadedDictionary) -> FileIdentity:
    dictionary, device = loaded.dictionary, loaded.device
    identity = told_identity(dictionary)
    name = held(dictionary, Cia301.DEVICE_NAME)
    return FileIdentity(
        vendor_name=device.vendor_name,
        product_name=device.product_name,
        order_code=device.order_code,
        vendor=next(iter(identity.vendor), None),
        product=next(iter(identity.product), None),
        revision=next(iter(identity.revision), None),
        device_name=name if isinstance(name, str) else "",
        device_type=held_number(dictionary, Cia301.DEVICE_TYPE),
    )


def _axes(dictionary: od.ObjectDictionary) -> int:
    """Count the axes that have a controlword; up to eight share a device."""
    return sum(Object.CONTROLWORD + AXIS_STEP * axis in dictionary for axis in range(8))


def _remarks(dictionary: od.ObjectDictionary, profile: int | None, judgement: Judgement) -> tuple[str, ...]:
    texts = list(judgement.conditions)
    if profile in (None, 0):
        texts.append("1000h gives no device profile: that it is a servo drive is concluded from its objects")
    served = judgement.usable
    if served and not any(mode in _TORQUE_MODES for mode in served):
        texts.append(f"no torque mode; {run_words(served)}")
    guarded = Cia301.GUARD_TIME in dictionary and Cia301.LIFE_TIME_FACTOR in dictionary
    if Cia301.CONSUMER_HEARTBEAT_TIME not in dictionary and guarded:
        texts.append("without 1016h the drive watches its host by life guarding (100Ch, 100Dh)")
    texts += _limited_ramps(dictionary, served)
    if _axes(dictionary) > 1:
        texts.append(f"it has {_axes(dictionary)} axes; the bench uses the first")
    return tuple(texts)


def _limited_ramps(dictionary: od.ObjectDictionary, served: Sequence[Mode]) -> list[str]:
    """Name ramps and speeds with a greatest value that a motor may find too slow, if every mode needs
    them."""
    obeyed = {mode: {*RAMPS.get(mode, ()), *SPEEDS.get(mode, ())} for mode in served}
    limited = {
        index: most
        for index in sorted(set().union(*obeyed.values()))
        if (most := _most(dictionary, index)) is not None and most < _RAMP_BOUNDLESS
    }
    if not all(limited.keys() & indices for indices in obeyed.values()):
        return []
    return [
        f"{index:04X}h takes {most} at most: hil commission refuses a mode that it makes too slow"
        for index, most in limited.items()
    ]


def _most(dictionary: od.ObjectDictionary, index: int) -> int | None:
    """Return the greatest value of an object, of a record that of its sub-index 1; None without one in the
    sheet."""
    entry = dictionary.get(index)
    return getattr(entry if isinstance(entry, od.ODVariable) else (entry or {}).get(1), "max", None)


# ---- what contradicts itself, beyond the form: the values stay as they are, and are told ------------------


def doubts(dictionary: od.ObjectDictionary, capability: PdoCapability) -> tuple[str, ...]:
    """Name impossible default mappings, and objects whose sub-index 0 is not their highest sub-index."""
    all_doubts = [doubt for slot in capability.slots for doubt in _of_mapping(slot, capability)]
    counts = [doubt for index, entry in dictionary.items() if (doubt := _of_count(index, entry))]
    if counts:
        all_doubts.append(f"sub-index 0 is not the highest sub-index: {_some(counts)}")
    return tuple(all_doubts)


def _of_mapping(slot: PdoSlot, capability: PdoCapability) -> Iterable[str]:
    wrong = []
    for word in slot.mapping:
        key, bits, named = key_of(word), word & 0xFF, mapping_text([word])
        if key[0] < FIRST_OBJECT:
            if key[0] not in capability.dummies:
                wrong.append(f"{named} is no placeholder that it offers")
            continue
        entry = capability.objects.get(key)
        if entry is None:
            wrong.append(f"{named} is no object of its own with a length")
        elif entry.bits != bits:
            wrong.append(f"{named} has {entry.bits} bits")
    if wrong:
        yield f"the mapping of {slot.name} in the file cannot be: {_some(wrong)}"
    total = sum(word & 0xFF for word in slot.mapping)
    if total > BITS_MAX:
        yield f"the mapping of {slot.name} in the file has {total} bits, and a PDO holds {BITS_MAX}"


def _of_count(index: int, entry: Any) -> str:
    # sub-index 0 of these counts the entries in use (CiA 301 7.5.2.3, 7.5.2.36, 7.5.2.38)
    in_use = index == Cia301.ERROR_HISTORY or is_mapping(index)
    if isinstance(entry, od.ODVariable) or in_use:
        return ""
    first = entry.subindices.get(0)
    if first is None or first.access_type not in ("ro", "const") or not isinstance(first.default, int):
        return ""
    highest = max(entry.subindices)
    return "" if first.default == highest else f"{index:04X}h says {first.default} and has {highest}"


def _some(named: list[str]) -> str:
    more = len(named) - _NAMED_MAX
    return "; ".join(named[:_NAMED_MAX]) + (f"; and {more} more" if more > 0 else "")
