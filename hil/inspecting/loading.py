"""Parameters of a file, or of another drive, loaded into a drive: compared, written, read back, undone.

    identity     vendor-ID and product code are those of the file, or nothing is written
    at rest      the drive is disabled and stands; before each write its statusword says so again
    compared     only what differs is written
    journal      each old value is on the disk before its write (``hil restore`` puts it back)
    written      PRE-OPERATIONAL; PDOs by their rules, the rest by what depends on what
    read back    everything, until nothing differs or nothing helps; what is left is named
    kept         1010h, if asked for

Whatever ends it, the drive is disabled, and the same load goes on where it ended.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Final

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import MANUFACTURER, Cia301
from servobench.drivers.canopen.write_list import NOTHING, WriteList
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import CONTROL, Object
from servobench.drivers.cia402.profile import state_of
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BenchError, PeerFault, TransferAborted
from servobench.drivers.sheets.concise import ConciseEntry, concise_bytes
from servobench.drivers.sheets.dictionary import value_text
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.execution.world import World
from servobench.hil.inspecting.parameters import CONNECT_NS, ParameterSet
from servobench.hil.inspecting.units import Place
from servobench.hil.restoring.journal import (
    Journal,
    JournaledNetwork,
    ObjectKey,
    ObjectWrite,
    restore_command,
)
from servobench.hil.restoring.restore import (
    DISABLED,
    bring_to_rest,
    enter_pre_operational,
    head_of,
    return_to,
    store_settings,
)
from servobench.hil.restoring.settings import download_order, write_settings, writes_to
from servobench.hil.write_lists import COMMISSION

JOURNAL: Final = "journal.jsonl"
_REST_UNITS: Final = 2
"""An encoder may jump to and fro."""
_REST_LOOKS: Final = 3
_LOOK: Final = Duration(20 * NS_PER_MS)
_AXIS: Final = 0x800
"""Objects from one axis to the next (CiA 402-2)."""
_PROFILE: Final = range(0x6000, 0xA000)
_UNIT_WORDS: Final = range(0x60A8, 0x60AC)
_UNITS: Final = frozenset(
    {Object.POLARITY, Object.MOTOR_RATED_CURRENT, Object.MOTOR_RATED_TORQUE, *range(0x6089, 0x6098)}
    | {*_UNIT_WORDS, *range(0x60E4, 0x60F0)}
)
"""Scaling of other objects' values."""
_BOUNDS: Final = frozenset(
    {Object.VL_VELOCITY_MIN_MAX_AMOUNT, Object.MAX_TORQUE, Object.MAX_CURRENT, Object.POSITION_RANGE_LIMIT}
    | {Object.SOFTWARE_POSITION_LIMIT, Object.MAX_PROFILE_VELOCITY, Object.MAX_MOTOR_SPEED}
    | {Object.MAX_ACCELERATION, Object.MAX_DECELERATION, 0x60E0, 0x60E1}
)
"""Limits of other objects' values."""


@dataclass(frozen=True, slots=True)
class LoadRequest:
    """The drive to load into."""

    bus: str
    bitrate_bit_s: int
    node: int
    out: Path
    """Folder of the journal."""
    store: bool = False
    """Have the drive keep its parameters."""

    @property
    def journal(self) -> Path:
        """The file of the journal."""
        return self.out / JOURNAL


@dataclass(slots=True)
class Loaded:
    """Result of loading."""

    parameters: int
    """How many there were to load."""
    differed: int = 0
    """Those that held another value."""
    refused: dict[Place, str] = field(default_factory=dict)
    """Parameters that hold another value at the end, and why."""
    stored: bool = False
    not_stored: str = ""
    """Why the drive did not store, if it was asked to."""

    @property
    def complete(self) -> bool:
        """The drive holds every parameter, and keeps them if asked to."""
        return not self.refused and not self.not_stored


def loading_network(world: World) -> JournaledNetwork:
    """Return a master that reads; :func:`load_parameters` allows it what it writes."""
    return JournaledNetwork(world.link, world.clock, NOTHING)


def concise_dcf(read: ParameterSet) -> bytes:
    """Return parameters as a concise DCF, which a manager may write in its order.

    A unit word of 0 is left out: drives refuse it, and take factors alone once those are written.
    """
    kept = [place for place, value in read.values.items() if place[0] not in _UNIT_WORDS or any(value)]
    values = {ObjectKey(*place): read.values[place] for place in sorted(kept, key=_rank)}
    return concise_bytes(ConciseEntry((key.index, key.sub), data) for key, data in download_order(values))


def load_parameters(
    network: JournaledNetwork,
    wanted: ParameterSet,
    request: LoadRequest,
    tell: Callable[[str], None],
    check_stop: Callable[[], None] = lambda: None,
) -> Loaded:
    """Bring a drive to the values ``wanted``. ``check_stop``: called before each write; may raise.

    Raises PeerFault for another device, or one that is enabled or moves, NoAnswer, BusDown; BadInput if the
    journal of something else waits in the folder.
    """
    drive = ServoDrive(network, request.node)
    identity = drive.connect(network.deadline_after(CONNECT_NS))
    _check_device(wanted, identity, request.node)
    check_rest(drive.objects)
    result = Loaded(len(wanted.values))
    held = _held(network, request.node, wanted, result)
    values = {ObjectKey(*place): wanted.values[place] for place in sorted(held, key=_rank)}
    result.differed = sum(
        not _alike(wanted.types[place], value, wanted.values[place]) for place, value in held.items()
    )
    journal = None
    try:
        with network.writes.only(_writes(network, request.node, values)):
            if result.differed or request.store or request.journal.exists():
                journal = _begin(network, drive.objects, identity, wanted, request)
                _note_all(journal, held | _unit_words(drive.objects, held), wanted)
                _write(network, drive.objects, wanted, values, result, check_stop)
                return_to(network, request.node, journal.contents.head.nmt)
            if request.store:
                check_disabled(drive.objects)
                _store(network, request.node, result)
    except BenchError:
        if journal is not None and journal.contents.changes:
            undo = restore_command(request.journal)
            tell(f"not all is loaded: the same command goes on with it, {undo} undoes it")
        raise
    finally:
        if journal is not None:
            journal.close()
    return result


def _begin(
    network: JournaledNetwork,
    objects: RemoteObjects,
    identity: Identity,
    wanted: ParameterSet,
    request: LoadRequest,
) -> Journal:
    head = head_of(objects, request.bus, request.bitrate_bit_s, identity)
    journal = Journal(request.journal, replace(head, loads=_digest(wanted.values)))
    network.journals[request.node] = journal
    enter_pre_operational(network, request.node)
    return journal


def _note_all(journal: Journal, held: Mapping[Place, bytes], wanted: ParameterSet) -> None:
    """Note all parameters before the first write, which may change other objects than its own."""
    known = journal.contents.originals()
    found = (
        ObjectWrite(ObjectKey(*place), held[place], wanted.values.get(place, held[place]))
        for place in sorted(held, key=_rank)
    )
    journal.note(*(each for each in found if each.object not in known))


def _unit_words(objects: RemoteObjects, held: Mapping[Place, bytes]) -> dict[Place, bytes]:
    """Return the unit words that are not to be loaded: a factor that is written may change them."""
    words = {(index, 0): objects.read_if_there(index) for index in _UNIT_WORDS if (index, 0) not in held}
    return {place: word.to_bytes(4, "little") for place, word in words.items() if word is not None}


def _digest(values: Mapping[Place, bytes]) -> str:
    lines = (f"{index:04X}:{sub:02X} {value.hex()}" for (index, sub), value in sorted(values.items()))
    return sha256("\n".join(lines).encode()).hexdigest()


def _writes(network: JournaledNetwork, node: int, values: Mapping[ObjectKey, bytes]) -> WriteList:
    product = network.writes.products.get(node)
    store = tuple(each for each in COMMISSION if each.indices[0] == Cia301.STORE_PARAMETERS)
    loaded = writes_to(values, product, "a parameter of the file", "now")
    return WriteList(f"loading into node {node}", (*CONTROL.writes, *store, *loaded))


def _check_device(wanted: ParameterSet, identity: Identity, node: int) -> None:
    parts = ("vendor-ID", "product code")
    for part, told, here in zip(parts, wanted.device, (identity.vendor, identity.product), strict=True):
        if here not in told and (here or told):
            theirs = " or ".join(f"{each:08X}h" for each in sorted(told)) or "not told"
            raise PeerFault(
                f"{wanted.source} is of another device: {part} {theirs}",
                f"node {node} says {here:08X}h",
                "nothing was written; give a file of this device",
            )


def check_rest(objects: RemoteObjects) -> None:
    """Raise PeerFault unless the drive is disabled and stands; nothing is sent to it but requests."""
    check_disabled(objects)
    places = []
    for _ in range(_REST_LOOKS):
        places.append(objects.read_if_there(Object.POSITION_ACTUAL_VALUE, 0, "i"))
        objects.network.pump(objects.network.deadline_after(_LOOK))
    first = places[0]
    moved = [place for place in places if place is not None and first is not None]
    if first is not None and any(abs(place - first) > _REST_UNITS for place in moved):
        raise PeerFault(
            f"node {objects.node_id} moves", f"6064h went from {first} to {moved[-1]}", _cure(objects)
        )


def check_disabled(objects: RemoteObjects) -> None:
    """Raise PeerFault unless the drive is disabled."""
    word = objects.read(Object.STATUSWORD, 0, "H")
    if state_of(word) not in DISABLED:
        raise PeerFault(f"node {objects.node_id} is not disabled", f"statusword {word:04X}h", _cure(objects))


def _cure(objects: RemoteObjects) -> str:
    stop = f"hil stop --bus {objects.network.link.name} --node {objects.node_id}"
    return f"parameters are loaded at rest: {stop}"


def _held(network: JournaledNetwork, node: int, wanted: ParameterSet, result: Loaded) -> dict[Place, bytes]:
    held = {}
    for place in wanted.values:
        try:
            held[place] = network.upload(node, *place)
        except TransferAborted as error:
            result.refused[place] = error.evidence
    return held


def _write(
    network: JournaledNetwork,
    objects: RemoteObjects,
    wanted: ParameterSet,
    values: Mapping[ObjectKey, bytes],
    result: Loaded,
    check_stop: Callable[[], None],
) -> None:
    def same(key: ObjectKey, held: bytes, value: bytes) -> bool:
        return _alike(wanted.types.get((key.index, key.sub), 0), held, value)

    def check() -> None:
        check_stop()
        try:
            check_disabled(objects)
        except PeerFault:
            bring_to_rest(objects)
            raise

    settings = write_settings(network, objects.node_id, values, same, check)
    for key, held_at_last in settings.held.items():
        place = key.index, key.sub
        if place in wanted.values:
            holds = "nothing" if held_at_last is None else value_text(held_at_last, wanted.types[place])
            result.refused[place] = settings.refusals.get(key) or f"holds {holds}"


def _alike(data_type: int, held: bytes, value: bytes) -> bool:
    """Return True if both are one value; a text may be filled up with zeros."""
    return held == value or value_text(held, data_type) == value_text(value, data_type)


def _store(network: JournaledNetwork, node: int, result: Loaded) -> None:
    try:
        store_settings(network, node)
    except PeerFault as error:
        result.not_stored = str(error)
    else:
        result.stored = True


def _rank(place: Place) -> tuple[int, Place]:
    """Order of writing: communication, the maker's, units, bounds, all else."""
    index = place[0]
    of_first_axis = _PROFILE[0] + (index - _PROFILE[0]) % _AXIS if index in _PROFILE else index
    if index < MANUFACTURER.start:
        return 0, place
    if index in MANUFACTURER:
        return 1, place
    if of_first_axis in _UNITS:
        return 2, place
    return 3 if of_first_axis in _BOUNDS else 4, place
