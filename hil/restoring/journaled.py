"""A CANopen master that writes into a node's dictionary only what the node's journal knows already."""

from typing import Final

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.objects301 import Cia301
from drivers.canopen.sdo import PostedDownload
from drivers.cia402.objects402 import Object
from drivers.errors import TransferAborted
from drivers.timebase import Clock
from drivers.wire.link import BusLink
from hil.restoring.journal import Journal, ObjectKey, ObjectWrite

COMMANDS: Final = frozenset({Object.CONTROLWORD, Cia301.STORE_PARAMETERS, Cia301.RESTORE_DEFAULTS})
"""What is written to these is an order, not a setting: there is nothing to put back."""
SET_POINTS: Final = (
    Object.MODES_OF_OPERATION,
    Object.TARGET_TORQUE,
    Object.TARGET_POSITION,
    Object.TARGET_VELOCITY,
)
"""They travel in PDOs too, where no download tells that they change."""


class JournaledNetwork(CanopenNetwork):
    """As its base; before each download to a node its journal gets what the object holds.

    Nothing may be written to a node without one.
    """

    def __init__(self, link: BusLink, clock: Clock) -> None:
        super().__init__(link, clock)
        self.journals: dict[int, Journal] = {}
        """By node."""
        self.putting_back = False
        """What is written now is in the journals already."""

    @property
    def journal(self) -> Journal | None:
        """Of the first node, where there is but one."""
        return next(iter(self.journals.values()), None)

    def begin_journal(self, journal: Journal) -> None:
        """From now on writes to its node are allowed. The set-points are noted at once."""
        node = journal.contents.head.node
        self.journals[node] = journal
        for index in SET_POINTS:
            self._note(node, index, 0, None)

    def download(self, node_id: int, index: int, sub: int, data: bytes) -> None:
        self._note(node_id, index, sub, data)
        super().download(node_id, index, sub, data)

    def post_download(self, node_id: int, index: int, sub: int, data: bytes) -> PostedDownload:
        self._note(node_id, index, sub, data)
        return super().post_download(node_id, index, sub, data)

    def _note(self, node_id: int, index: int, sub: int, data: bytes | None) -> None:
        if self.putting_back:
            return
        journal = self.journals.get(node_id)
        if journal is None:
            raise AssertionError(f"a write to {index:04X}h of node {node_id} before there is a journal")
        if index in COMMANDS:
            return
        try:
            old = self.upload(node_id, index, sub)
        except TransferAborted:
            return  # what cannot be read cannot be put back, and is no setting
        journal.note(ObjectWrite(ObjectKey(index, sub), old, old if data is None else data))
