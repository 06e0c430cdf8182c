"""Putting a drive back as a journal found it: every changed object, byte for byte.

The order matters. The drive is brought to rest and disabled, and is pre-operational. PDOs come first, all
else in the reverse order of the changes (:mod:`servobench.hil.restoring.settings`), so that what the watch
over the host rests on goes last; parameters that were loaded in the order of loading. Then the NMT state.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.canopen.write_list import Product, WriteList
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import CONTROLWORDS, DriveCommand, State, state_of
from servobench.drivers.errors import NoAnswer, PeerFault, TransferAborted
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.restoring.journal import DriveMark, JournalContents, JournalHead
from servobench.hil.restoring.settings import write_settings, writes_to
from servobench.hil.write_lists import PUTTING_BACK

REST_LIMIT: Final = Duration(5 * NS_PER_S)
"""A drive with a ramp of its own takes seconds."""
_REST_COUNTS: Final = 3
"""Readings in a row without a change of position, 20 ms apart, that count as rest."""
_BEATS_HEARD: Final = 2.5
"""Heartbeat periods in which one comes for certain, though one be lost."""
SAVE: Final = b"save"
"""Signature of 1010h."""
_STORE_LIMIT: Final = Duration(2 * NS_PER_S)
"""A drive answers 1010h once its memory is written (CiA 301 7.5.2.13), long after any other download."""
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
    product = network.writes.products.get(contents.head.node)
    with network.writes.only(_writes_back(contents, product)):
        return _restore(network, contents, tell)


def _writes_back(contents: JournalContents, product: Product | None) -> WriteList:
    """Return the objects in a journal, and those that have to change beside them for a while."""
    changed = writes_to(contents.originals(), product, "changed", "now")
    return WriteList(f"restoring node {contents.head.node}", (*PUTTING_BACK.writes, *changed))


def _restore(network: CanopenNetwork, contents: JournalContents, tell: Callable[[str], None]) -> Restoration:
    node = contents.head.node
    objects = RemoteObjects(network, node)
    tell("bringing the drive to rest")
    bring_to_rest(objects)
    enter_pre_operational(network, node)
    originals = contents.originals()
    result = Restoration(objects=len(originals))
    order = originals.items() if contents.head.loads else reversed(originals.items())
    settings = write_settings(network, node, dict(order))
    result.written = len(settings.written)
    for key in sorted(settings.held, key=list(originals).index):
        held = settings.held[key]
        holds = "cannot be read" if held is None else f"holds {held.hex()}"
        result.failures.append(f"{key} {holds} instead of {originals[key].hex()}")
    if contents.head.errors == 0:
        _clear_history(objects)
    return_to(network, node, contents.head.nmt)
    return result


def enter_pre_operational(network: CanopenNetwork, node: int) -> None:
    """Have a node take no RPDO any more, and wait until it does not."""
    network.command(NmtCommand.ENTER_PRE_OPERATIONAL, node)
    network.pump(network.deadline_after(Duration(20 * NS_PER_MS)))


def return_to(network: CanopenNetwork, node: int, state: int | None) -> None:
    """Command the NMT state in which a node was found; None: unknown, it stays in the present one."""
    if state is not None and state in _NMT_OF_STATE:
        network.command(_NMT_OF_STATE[NmtState(state)], node)


def store_settings(network: CanopenNetwork, node: int) -> None:
    """Have a drive keep its settings, 1010h:1 (CiA 301 7.5.2.13). Raises PeerFault."""
    before = network.sdo_timeout_s
    network.sdo_timeout_s = _STORE_LIMIT / NS_PER_S
    try:
        network.download(node, Cia301.STORE_PARAMETERS, 1, SAVE)
    finally:
        network.sdo_timeout_s = before
        network.pump(network.deadline_after(Duration(50 * NS_PER_MS)))


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


def _clear_history(objects: RemoteObjects) -> None:
    """Clear 1003h, which was empty: its entries come from the host watch test, or from the host's end.

    Writing 0 clears it (CiA 301 7.5.2.3); a drive that does not let it be cleared keeps it.
    """
    if objects.read_if_there(Cia301.ERROR_HISTORY, 0, "B"):
        with suppress(TransferAborted):
            objects.write(Cia301.ERROR_HISTORY, 0, "B", 0)


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
