"""Data sheets and scales of the nodes of a log, by whoever knows them beforehand."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.sheets.dictionary import load_dictionary
from servobench.hil.reviewing.trace.node_objects import NodeObjects

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
