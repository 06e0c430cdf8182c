"""The files of a simulated device on the command line: its data sheet and its memory."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from drivers.dictionary import load_dictionary
from drivers.errors import BadInput
from virtual_bus.canopen_device.object_dictionary import ObjectDictionary
from virtual_bus.canopen_device.parameter_store import FileStore
from virtual_bus.canopen_device.vendor_dictionary import BASE_NODE_ID, overlay

REPAIRS_SHOWN = 5


class DeviceFiles(NamedTuple):
    """What a device is made from beside motor and faults."""

    eds: Path | None = None
    """EDS or DCF (CiA 306-1) that says which objects are on the bus."""
    store: Path | None = None
    """Where 1010h and LSS store, over the end of the process."""

    def vendor(self, announce: Callable[[str], None]) -> Callable[[ObjectDictionary], None] | None:
        """What lays the data sheet over a device's dictionary; ``announce`` hears what had to be mended.

        Raises BadInput if the file cannot be read.
        """
        if self.eds is None:
            return None
        loaded = load_dictionary(self.eds, BASE_NODE_ID)
        for repair in loaded.repairs[:REPAIRS_SHOWN]:
            announce(f"{self.eds}: {repair}")
        if len(loaded.repairs) > REPAIRS_SHOWN:
            announce(f"{self.eds}: and {len(loaded.repairs) - REPAIRS_SHOWN} more repairs of that kind")
        return partial(overlay, vendor=loaded.dictionary)

    def memory(self, nodes: Sequence[int]) -> FileStore | None:
        """The store of the one device in ``nodes``. Raises BadInput for several, or for a foreign file."""
        if self.store is None:
            return None
        if len(nodes) > 1:
            raise BadInput(
                "--store",
                "",
                str(self.store),
                "one --node, for the file is the memory of one device",
                "start a process for each node, each with a file of its own",
            )
        store = FileStore(self.store)
        store.load()
        return store
