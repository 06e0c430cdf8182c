"""Parameters of a drive: what its objects hold, kept in a DCF (CiA 306-1), and compared.

A parameter is a writable object that keeps its value. Commands, set-points, the error history, clocks and
domains are none: they say what a drive does at this moment, or change by themselves.
"""

import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, export_od

from servobench.drivers.canopen.cob_ids import CAN_ID, EMERGENCY, NODE_BITS, RPDOS, TPDOS
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import (
    MANUFACTURER,
    SIGNED_BITS,
    Cia301,
    DataType,
    is_communication,
    is_mapping,
    object_name,
)
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, PeerFault, TransferAborted
from servobench.drivers.sheets.concise import is_concise, read_concise
from servobench.drivers.sheets.dictionary import (
    NUMBERS,
    is_kept,
    load_dictionary,
    told_identity,
    value_text,
    variables_in,
)
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.inspecting.units import Place, SiUnit, read_units, units_of, with_unit
from servobench.hil.inspecting.upload_scan import EVERY_INDEX, FILES, scan_objects

NO_PARAMETERS: Final = FILES | frozenset(
    {
        Cia301.ERROR_HISTORY,
        Cia301.STORE_PARAMETERS,
        Cia301.RESTORE_DEFAULTS,
        Cia301.HIGH_RESOLUTION_TIME_STAMP,
        Object.CONTROLWORD,
        Object.MODES_OF_OPERATION,
        Object.TARGET_TORQUE,
        Object.TARGET_POSITION,
        Object.TARGET_VELOCITY,
        Object.VL_TARGET_VELOCITY,
        Object.INTERPOLATION_DATA_RECORD,
    }
)
CONNECT_NS: Final = Duration(2 * NS_PER_S)
"""Somebody waits at the terminal, and a drive that is on answers at once."""
_OWN: Final = re.compile(r"node.?(id|address)|baud.?rate|bit.?(rate|timing)|serial.?n", re.IGNORECASE)
"""Names of makers' objects that hold a device's place on its bus, or its serial number."""
_PREDEFINED: Final = frozenset({*TPDOS, *RPDOS, EMERGENCY})


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """Parameters of a drive, or of a file."""

    source: str
    """The file, or the node and its bus."""
    device: tuple[frozenset[int], frozenset[int]]
    """Vendor-IDs and product codes (1018h, [DeviceInfo]); empty where a file tells none."""
    values: Mapping[Place, bytes]
    names: Mapping[Place, str]
    types: Mapping[Place, int]
    """Data types (CiA 301 7.4.7)."""
    unread: Mapping[Place, str]
    """Parameters of the data sheet that the drive did not give, with its reason; of a concise DCF, what the
    sheet does not have as a parameter."""
    units: Mapping[Place, SiUnit] = field(default_factory=dict)
    """Units that are known."""
    node: int | None = None
    """Node-ID of the drive; None for a file that tells none."""


class ParameterDifference(NamedTuple):
    """A parameter that two sets do not share; a value that one of them lacks is empty."""

    place: Place
    name: str
    first: str
    second: str
    first_si: str = ""
    """In its unit; empty if none is known."""
    second_si: str = ""


def read_parameters(
    network: CanopenNetwork,
    node: int,
    sheet: Path | None,
    bus: str,
    tell: Callable[[str], None],
    indices: Sequence[range] = EVERY_INDEX,
) -> tuple[ParameterSet, ObjectDictionary, Identity]:
    """Upload every parameter that the data sheet names; without one, of all objects of ``indices`` that are
    there, those that held the same twice.

    Raises BadInput for a data sheet that cannot be read, PeerFault if it is of another device, NoAnswer.
    """
    dictionary = None if sheet is None else load_dictionary(sheet, node).dictionary
    identity = ServoDrive(network, node).connect(network.deadline_after(CONNECT_NS))
    scanned = None
    if dictionary is None:
        scanned = scan_objects(network, node, indices, tell)
        dictionary = scanned.dictionary
    for part, of_sheet, of_drive in told_identity(dictionary).strangers(
        identity.vendor, identity.product, identity.revision
    ):
        if part == "revision":
            tell(f"revision {of_drive:08X}h, the data sheet is for {of_sheet:08X}h")
            continue
        raise PeerFault(
            f"{sheet} is of another device: {part} {of_sheet:08X}h",
            f"node {node} says {of_drive:08X}h",
            "give the data sheet of this drive",
        )
    values, unread = dict[Place, bytes](), dict[Place, str]()
    if scanned is not None:
        unread |= {place: why for place, why in scanned.unread.items() if place[0] not in NO_PARAMETERS}
    for variable in list(parameters_in(dictionary)):
        place = variable.index, variable.subindex
        try:
            value = network.upload(node, *place)
        except TransferAborted as error:
            unread[place] = str(error)
            continue
        if scanned is not None and scanned.values[place] != value:
            variable.access_type = "ro"
        elif is_kept(value, variable.data_type):
            values[place] = value
        else:
            unread[place] = f"a DCF cannot hold its text {value!r}"
    device = frozenset((identity.vendor,)), frozenset((identity.product,))
    read = _described(dictionary, f"node {node} on {bus}", device, values, unread)
    return replace(read, node=node), dictionary, identity


def parameters_of(path: Path, node: int | None = None, sheet: Path | None = None) -> ParameterSet:
    """Read the parameter values of a DCF, concise DCF or XDC; identifiers that follow the node-ID are those
    of ``node``, default: the file's own. ``sheet``: the data sheet that tells device and types of a concise
    DCF.

    Raises BadInput for a file without parameter values, or a concise DCF without ``sheet``.
    """
    concise = is_concise(path)
    if concise and sheet is None:
        cure = "--eds FILE of the device: a concise DCF tells neither device nor types"
        raise BadInput(str(path), "", "a concise DCF alone", "a data sheet beside it", cure)
    loaded = load_dictionary(sheet if concise and sheet else path, node)
    values, left = dict[Place, bytes](), dict[Place, str]()
    dictionary = loaded.dictionary
    if concise:
        known = {(each.index, each.subindex) for each in parameters_in(dictionary)}
        written = dict[Place, bytes](read_concise(path))
        values = {place: data for place, data in written.items() if place in known}
        left = {place: "no parameter of the data sheet" for place in written if place not in known}
    for variable in parameters_in(dictionary):
        value = values.get((variable.index, variable.subindex))
        if value is not None and variable.data_type in NUMBERS:  # units follow from values
            to_write: Any = variable
            to_write.value = int.from_bytes(value, "little", signed=variable.data_type in SIGNED_BITS)
        elif not concise and variable.value is not None:
            values[variable.index, variable.subindex] = _encoded(variable, path)
    if not values:
        cure = "hil params save writes one; an EDS or XDD tells defaults only"
        raise BadInput(str(path), "ParameterValue", "none", "a DCF or XDC with parameter values", cure)
    told = told_identity(dictionary)
    device = frozenset(told.vendor), frozenset(told.product)
    told_node = node if concise or loaded.commissioning is None else loaded.commissioning.node_id or node
    described = _described(dictionary, str(path), device, values, left)
    return replace(described, units=units_of(dictionary), node=told_node)


def compared_drive(
    network: CanopenNetwork, node: int, sheet: Path, bus: str, tell: Callable[[str], None]
) -> ParameterSet:
    """Upload every parameter that the data sheet names, with the drive's units; see
    :func:`read_parameters`."""
    read, dictionary, _ = read_parameters(network, node, sheet, bus, tell)
    return replace(read, units=read_units(network, node, dictionary))


def configuration_text(
    read: ParameterSet, dictionary: ObjectDictionary, identity: Identity, bitrate_bit_s: int
) -> str:
    """Return the data sheet as a DCF (CiA 306-1), with the values of ``read`` as its ParameterValues."""
    for variable in variables_in(dictionary):
        value = read.values.get((variable.index, variable.subindex))
        to_write: Any = variable  # canopen adds value_raw to what it has read of a file
        to_write.value_raw = None if value is None else value_text(value, variable.data_type)
        to_write.value = None
    device = dictionary.device_information
    device.vendor_number, device.product_number = identity.vendor, identity.product
    device.revision_number = identity.revision
    dictionary.bitrate = bitrate_bit_s
    text = io.StringIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # datetime.utcnow() in canopen
        export_od(dictionary, text, "dcf")
    return text.getvalue()


def for_node(parameters: ParameterSet, node: int | None) -> tuple[ParameterSet, dict[Place, str]]:
    """Return the parameters of a node as ``node`` is to have them, and what is left to that device.

    Identifiers of the predefined connection set follow the node-ID (CiA 301 7.3.5). Its node-ID, bit rate and
    serial number are a device's own. Where one of the two is not known, nothing is moved.
    """
    source = parameters.node
    if node is None or source is None or source == node:
        return parameters, {}
    left = {
        place: "its own"
        for place, name in parameters.names.items()
        if place in parameters.values and place[0] in MANUFACTURER and _OWN.search(name)
    }
    values = {
        place: _moved(place, value, source, node)
        for place, value in parameters.values.items()
        if place not in left
    }
    return replace(parameters, values=values, node=node), left


def _moved(place: Place, value: bytes, source: int, node: int) -> bytes:
    index, sub = place
    if not (index == Cia301.EMCY_COB_ID or (is_communication(index) and sub == 1)):
        return value
    cob_id = int.from_bytes(value, "little")
    if cob_id & NODE_BITS != source or cob_id & CAN_ID & ~NODE_BITS not in _PREDEFINED:
        return value
    return (cob_id - source + node).to_bytes(len(value), "little")


def differences(first: ParameterSet, second: ParameterSet) -> list[ParameterDifference]:
    """Return the parameters in which two sets differ, by index and sub-index.

    Parameters that only one of them has are among them, with an empty value of the other. Sets of two nodes
    do not differ in what follows the node-ID, nor in what is a device's own (:func:`for_node`). Raises
    BadInput for sets of two types of device.
    """
    for part, mine, theirs in zip(("vendor-ID", "product code"), first.device, second.device, strict=True):
        if mine and theirs and not mine & theirs:
            told, expected = (" or ".join(f"{each:08X}h" for each in sorted(ids)) for ids in (theirs, mine))
            raise BadInput(second.source, f"1018h {part}", told, f"{expected}, that of {first.source}")
    moved, left = for_node(first, second.node)
    found = []
    for place in sorted(first.values.keys() | second.values.keys()):
        owner = first if place in first.values else second
        texts = [_compared(each.values.get(place), owner.types[place]) for each in (first, second)]
        unused = is_mapping(place[0]) and all(text in ("", "0x0") for text in texts)
        if texts[0] == texts[1] or place in left or unused:
            continue
        if moved.values.get(place) != second.values.get(place):
            si = (
                with_unit(each.values.get(place, b""), owner.types[place], each.units.get(place))
                for each in (first, second)
            )
            found.append(ParameterDifference(place, owner.names[place], *texts, *si))
    return found


def _compared(value: bytes | None, data_type: int) -> str:
    """Return a value as it is compared and shown; a DCF does not tell an empty text from none."""
    return "" if value is None else value_text(value, data_type)


def parameters_in(dictionary: ObjectDictionary) -> Iterator[ODVariable]:
    """Yield the variables of a data sheet that are parameters."""
    for variable in variables_in(dictionary):
        kept = variable.index not in NO_PARAMETERS and variable.data_type != DataType.DOMAIN
        if kept and variable.writable and variable.readable:
            yield variable


def _encoded(variable: ODVariable, path: Path) -> bytes:
    place = object_name(variable.index, variable.subindex)
    value: Any = variable.value
    try:
        if variable.data_type in NUMBERS and isinstance(value, int):
            length = -(-NUMBERS[DataType(variable.data_type)] // 8)
            return value.to_bytes(length, "little", signed=value < 0)
        return bytes(variable.encode_raw(value))
    except (OverflowError, TypeError, ValueError) as error:
        raise BadInput(str(path), place, value, "a value of its DataType", str(error)) from None


def _described(
    dictionary: ObjectDictionary,
    source: str,
    device: tuple[frozenset[int], frozenset[int]],
    values: Mapping[Place, bytes],
    unread: Mapping[Place, str],
) -> ParameterSet:
    names, types = dict[Place, str](), dict[Place, int]()
    for variable in parameters_in(dictionary):
        place = variable.index, variable.subindex
        parent = variable.parent
        above = f"{parent.name}: " if isinstance(parent, ODArray | ODRecord) else ""
        names[place], types[place] = above + variable.name, variable.data_type or 0
    return ParameterSet(source, device, values, names, types, unread)
