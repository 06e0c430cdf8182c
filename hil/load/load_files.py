"""Loads over time from files, as simulated shafts bear them."""

from collections.abc import Sequence
from pathlib import Path

from drivers.errors import BadInput
from hil.configuration.signal_file import Signal, load_signal
from hil.loop.scenario import Quantity
from virtual_bus.drive.load_table import LoadTable

OPTION = "--load"


def load_table(signal: Signal) -> LoadTable:
    """What a simulated shaft bears of it."""
    return LoadTable.of(signal.times_s, signal.levels)


def load_tables(asked: Sequence[str], nodes: Sequence[int]) -> dict[int, LoadTable]:
    """By node, of ``asked``, each NODE=FILE. Raises BadInput."""
    tables: dict[int, LoadTable] = {}
    for text in asked:
        node, _, name = text.partition("=")
        if not name or not node.isdecimal() or len(node) > 3 or int(node) not in nodes or int(node) in tables:
            listed = ", ".join(map(str, nodes))
            raise BadInput(OPTION, "", text, f"NODE=FILE with one of the nodes {listed}, each once")
        signal = load_signal(Path(name))
        if signal.quantity is not Quantity.TORQUE:
            raise BadInput(OPTION, "", text, "a file with torque_nm")
        tables[int(node)] = load_table(signal)
    return tables
