"""A CANopen master that writes into one node's dictionary only what its journal knows already."""

from typing import Final

from drivers.errors import TransferAborted
from drivers.network import CanopenNetwork
from drivers.objects402 import Object
from drivers.sdo import PostedDownload
from hil.commissioning.journal import Change, Journal, ObjectKey

STORE_PARAMETERS: Final = 0x1010
RESTORE_DEFAULTS: Final = 0x1011
COMMANDS: Final = frozenset({Object.CONTROLWORD, STORE_PARAMETERS, RESTORE_DEFAULTS})
"""What is written to these is an order, not a setting: there is nothing to put back."""
SET_POINTS: Final = (
    Object.MODES_OF_OPERATION,
    Object.TARGET_TORQUE,
    Object.TARGET_POSITION,
    Object.TARGET_VELOCITY,
)
"""They travel in PDOs too, where no download tells that they change."""


class JournaledNetwork(CanopenNetwork):
    """As its base; before each download to ``node`` the journal gets what the object holds."""

    journal: Journal | None = None
    """None: nothing may be written to any node."""
    putting_back = False
    """What is written now is in the journal already."""

    def begin_journal(self, journal: Journal) -> None:
        """From now on writes are allowed. The set-points are noted at once."""
        self.journal = journal
        for index in SET_POINTS:
            self._note(journal.contents.head.node, index, 0, None)

    def download(self, node_id: int, index: int, sub: int, data: bytes) -> None:
        self._note(node_id, index, sub, data)
        super().download(node_id, index, sub, data)

    def post_download(self, node_id: int, index: int, sub: int, data: bytes) -> PostedDownload:
        self._note(node_id, index, sub, data)
        return super().post_download(node_id, index, sub, data)

    def _note(self, node_id: int, index: int, sub: int, data: bytes | None) -> None:
        journal = self.journal
        if self.putting_back:
            return
        if journal is None:
            raise AssertionError(f"a write to {index:04X}h before there is a journal")
        assert node_id == journal.contents.head.node, "only the node of the journal may be written to"
        if index in COMMANDS:
            return
        try:
            old = self.upload(node_id, index, sub)
        except TransferAborted:
            return  # what cannot be read cannot be put back, and is no setting
        journal.note(Change(ObjectKey(index, sub), old, old if data is None else data))
