"""Putting a drive back as a journal found it: every changed object, byte for byte.

The order matters. The drive is brought to rest and disabled, and is pre-operational. PDOs come first, by the
rules of CiA 301 7.5.2.35 to 7.5.2.38: all that changed are switched off, then each gets its parameters with
the mapping's count at 0 meanwhile, and its COB-ID last. Everything else goes back in the reverse order of the
changes, so that what the watch over the host rests on goes last. Then the NMT state.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from servobench.drivers.canopen.cob_ids import NOT_VALID
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import MAPPING_OFFSET, PDO_PARAMETERS, Cia301
from servobench.drivers.canopen.write_list import ListedWrite, WriteList
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import CONTROLWORDS, DriveCommand, State, state_of
from servobench.drivers.errors import NoAnswer, PeerFault, TransferAborted
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.restoring.journal import DriveMark, JournalContents, JournalHead, ObjectKey
from servobench.hil.write_lists import PUTTING_BACK

REST_LIMIT: Final = Duration(5 * NS_PER_S)
"""A drive with a ramp of its own takes seconds."""
_REST_COUNTS: Final = 3
"""Readings in a row without a change of position, 20 ms apart, that count as rest."""
_BEATS_HEARD: Final = 2.5
"""Heartbeat periods in which one comes for certain, though one be lost."""
DISABLED: Final = (State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON, State.FAULT)
"""States in which the motor gets no torque (CiA 402-2)."""
_NMT_OF_STATE: Final = {
    NmtState.OPERATIONAL: NmtCommand.START,
    NmtState.PRE_OPERATIONAL: NmtCommand.ENTER_PRE_OPERATIONAL,
    NmtState.STOPPED: NmtCommand.STOP,
}


@dataclass(slots=True)
class Restoration:
    """Result of restoring."""

    objects: int = 0
    """How many there were to put back."""
    written: int = 0
    """Number of these that held another value."""
    failures: list[str] = field(default_factory=list)
    """Objects that still hold something else, and why."""

    @property
    def complete(self) -> bool:
        """Everything is as it was."""
        return not self.failures


def restore(
    network: CanopenNetwork, contents: JournalContents, tell: Callable[[str], None] = lambda _text: None
) -> Restoration:
    """Put everything back; raises NoAnswer or BusDown if the drive cannot be reached.

    A drive that cannot be brought to rest keeps its settings, for they may be what stops it: PeerFault.
    """
    with network.writes.only(_writes_back(contents)):
        return _restore(network, contents, tell)


def _writes_back(contents: JournalContents) -> WriteList:
    """Return the objects in a journal, and those that switch its PDOs off and on."""
    keys = set(contents.originals())
    for pdo in {pdo for key in keys if (pdo := pdo_of(key.index)) is not None}:
        keys |= {ObjectKey(pdo, 1), ObjectKey(pdo + MAPPING_OFFSET, 0)}
    named = (
        ListedWrite(range(key.index, key.index + 1), (key.sub,), str(key), "changed", "now")
        for key in sorted(keys)
    )
    return WriteList(f"restoring node {contents.head.node}", (*PUTTING_BACK.writes, *named))


def _restore(network: CanopenNetwork, contents: JournalContents, tell: Callable[[str], None]) -> Restoration:
    node = contents.head.node
    objects = RemoteObjects(network, node)
    tell("bringing the drive to rest")
    bring_to_rest(objects)
    network.command(NmtCommand.ENTER_PRE_OPERATIONAL, node)
    network.pump(network.deadline_after(Duration(20 * NS_PER_MS)))
    originals = contents.originals()
    result = Restoration(objects=len(originals))
    pdos = {key: value for key, value in originals.items() if pdo_of(key.index) is not None}
    _put_back_pdos(objects, pdos, result)
    for key in reversed([key for key in originals if key not in pdos]):
        _put_back(network, node, key, originals[key], result)
    result.failures += _differences(network, node, originals)
    if contents.head.errors == 0:
        _clear_history(objects)
    state = contents.head.nmt
    if state is not None and state in _NMT_OF_STATE:
        network.command(_NMT_OF_STATE[NmtState(state)], node)
    return result


def head_of(objects: RemoteObjects, bus: str, bitrate_bit_s: int, identity: Identity) -> JournalHead:
    """How a drive is found, for the head of its journal; waits for its heartbeat, if it sends one."""
    mark = DriveMark(identity.vendor, identity.product, identity.serial)
    errors = objects.read_if_there(Cia301.ERROR_HISTORY, 0, "B")
    return JournalHead(bus, objects.node_id, mark, _nmt_heard(objects), errors, bitrate_bit_s)


def _nmt_heard(objects: RemoteObjects) -> int | None:
    """The NMT state by the drive's heartbeat; None if it sends none."""
    network = objects.network
    try:
        period_ms = objects.read_if_there(Cia301.PRODUCER_HEARTBEAT_TIME, 0, "H")
    except NoAnswer:
        period_ms = None
    if not period_ms:
        return None
    status = network.status(objects.node_id)
    network.pump(network.deadline_after(Duration(round(_BEATS_HEARD * period_ms * NS_PER_MS))))
    return None if status.state is None else int(status.state)


def bring_to_rest(objects: RemoteObjects, limit: Duration = REST_LIMIT) -> None:
    """Quick stop, wait for rest, disable. Raises PeerFault if the shaft still moves at the limit.

    A drive without 6064h is at rest as soon as it has disabled itself: in quick stop it may still turn.
    """
    network = objects.network
    deadline = network.deadline_after(limit)
    last: int | None = None
    calm = 0
    while network.clock.now() < deadline:
        state = state_of(objects.read(Object.STATUSWORD, 0, "H"))
        if state in (State.OPERATION_ENABLED, State.QUICK_STOP):
            objects.write(Object.CONTROLWORD, 0, "H", CONTROLWORDS[DriveCommand.QUICK_STOP])
        position = objects.read_if_there(Object.POSITION_ACTUAL_VALUE, 0, "i")
        stopped = state in DISABLED or (state is State.QUICK_STOP and position is not None)
        calm = calm + 1 if stopped and position == last else 0
        last = position
        if calm >= _REST_COUNTS:
            objects.write(Object.CONTROLWORD, 0, "H", CONTROLWORDS[DriveCommand.DISABLE_VOLTAGE])
            return
        network.pump(Instant(network.clock.now() + 20 * NS_PER_MS))
    raise PeerFault(
        f"node {objects.node_id} was not brought to rest",
        f"statusword {objects.read(Object.STATUSWORD, 0, 'H'):04X}h",
        "stop it by its own means; its settings were left as they are",
    )


def pdo_of(index: int) -> int | None:
    """The communication parameter of the PDO that an object belongs to; None for any other object."""
    return index & ~MAPPING_OFFSET if index in PDO_PARAMETERS else None


def _clear_history(objects: RemoteObjects) -> None:
    """Clear 1003h, which was empty: its entries come from the host watch test, or from the host's end.

    Writing 0 clears it (CiA 301 7.5.2.3); a drive that does not let it be cleared keeps it.
    """
    if objects.read_if_there(Cia301.ERROR_HISTORY, 0, "B"):
        _attempt(objects.network, objects.node_id, ObjectKey(Cia301.ERROR_HISTORY, 0), b"\0")


def _put_back_pdos(objects: RemoteObjects, originals: dict[ObjectKey, bytes], result: Restoration) -> None:
    """Only PDOs that differ are touched: one with a fixed mapping was never changed."""
    network, node = objects.network, objects.node_id
    differing = {
        pdo
        for key, value in originals.items()
        if (pdo := pdo_of(key.index)) is not None and _held(network, node, key) != value
    }
    alive: dict[ObjectKey, bytes] = {}
    for pdo in sorted(differing):
        cob_id = objects.read_if_there(pdo, 1)
        if cob_id is not None and not cob_id & NOT_VALID:
            alive[ObjectKey(pdo, 1)] = cob_id.to_bytes(4, "little")
            _attempt(network, node, ObjectKey(pdo, 1), (cob_id | NOT_VALID).to_bytes(4, "little"))
    for pdo in sorted(differing):
        own = {key: value for key, value in originals.items() if pdo_of(key.index) == pdo}
        mapping = {key: value for key, value in own.items() if key.index != pdo}
        if mapping:
            count = ObjectKey(pdo + MAPPING_OFFSET, 0)
            size = own.get(count) or _held(network, node, count) or b"\0"
            _attempt(network, node, count, b"\0")
            for key in sorted(key for key in mapping if key.sub):
                _put_back(network, node, key, mapping[key], result)
            _put_back(network, node, count, size, result)
        for key in sorted(key for key in own if key.index == pdo and key.sub != 1):
            _put_back(network, node, key, own[key], result)
    for pdo in sorted(differing):
        key = ObjectKey(pdo, 1)
        held = originals.get(key, alive.get(key))
        if held is not None:
            _put_back(network, node, key, held, result)


def _put_back(network: CanopenNetwork, node: int, key: ObjectKey, value: bytes, result: Restoration) -> None:
    if _held(network, node, key) != value:
        result.written += 1
        _attempt(network, node, key, value)


def _attempt(network: CanopenNetwork, node: int, key: ObjectKey, value: bytes) -> None:
    """Write; a refusal shows in the comparison at the end."""
    with suppress(TransferAborted):
        network.download(node, key.index, key.sub, value)


def _held(network: CanopenNetwork, node: int, key: ObjectKey) -> bytes | None:
    try:
        return network.upload(node, key.index, key.sub)
    except TransferAborted:
        return None


def _differences(network: CanopenNetwork, node: int, originals: dict[ObjectKey, bytes]) -> list[str]:
    differences = []
    for key, value in originals.items():
        held = _held(network, node, key)
        if held != value:
            holds = "cannot be read" if held is None else f"holds {held.hex()}"
            differences.append(f"{key} {holds} instead of {value.hex()}")
    return differences


def await_answer(network: CanopenNetwork, node: int, limit: Duration) -> None:
    """Wait until the node answers SDO requests. Raises NoAnswer."""
    deadline = network.deadline_after(limit)
    while True:
        try:
            network.upload(node, Cia301.DEVICE_TYPE, timeout_s=0.1, attempts=1)
        except NoAnswer:
            if network.clock.now() >= deadline:
                raise
        else:
            return
