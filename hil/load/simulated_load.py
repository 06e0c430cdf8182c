"""Loads of ``hil simulate``: over time from files, or by an instrument at a pseudo-terminal, its brake on a
drive's shaft.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from servobench.design.motor import PmsmParameters
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.references import Signal, load_signal
from servobench.hil.loop.scenario import Quantity
from servobench.virtual_bus.drive.load_object import LoadTable
from servobench.virtual_bus.instruments.dynamometer import Brake, Instrument, InstrumentAtTerminal, Shaft
from servobench.virtual_bus.instruments.serial_line import LineFaults, PseudoTerminal

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import SimulatedServo

OPTION = "--load"


def load_table(signal: Signal) -> LoadTable:
    """Return the table of a signal for a simulated shaft."""
    return LoadTable(signal.times_s, signal.levels)


def load_tables(asked: Sequence[str], nodes: Sequence[int]) -> dict[int, LoadTable]:
    """Return the tables by node, from ``asked``, each NODE=FILE. Raises BadInput."""
    tables: dict[int, LoadTable] = {}
    for text in asked:
        node, _, name = text.partition("=")
        if not name or not node.isdecimal() or len(node) > 3 or int(node) not in nodes or int(node) in tables:
            listed = ", ".join(map(str, nodes))
            raise BadInput(OPTION, "", text, f"NODE=FILE with one of the nodes {listed}, each once")
        signal = load_signal(Path(name), NamedBy(OPTION, "", name))
        if signal.quantity is not Quantity.TORQUE:
            raise BadInput(OPTION, "", text, "a file with torque_nm")
        tables[int(node)] = load_table(signal)
    return tables


@dataclass(frozen=True, slots=True)
class SimulatedLoadMachine:
    """A load machine requested on the command line."""

    link: Path
    faults: LineFaults
    torque_max_nm: float

    @classmethod
    def wanted(
        cls, link: Path | None, faults: Sequence[str], motor: PmsmParameters
    ) -> "SimulatedLoadMachine | None":
        """None if there is to be none. Raises BadInput for faults of nothing."""
        if link is None:
            if faults:
                raise BadInput("--load-machine-fault", "", faults[0], "--load-machine PATH beside it")
            return None
        parsed = LineFaults.parse(list(faults), "--load-machine-fault")
        return cls(link, parsed, motor.torque_max_nm)

    @contextmanager
    def coupled_to(
        self, servo: "SimulatedServo", seed: int, announce: Callable[[str], None]
    ) -> Iterator[InstrumentAtTerminal]:
        """The instrument on the shaft of ``servo``, to be hosted beside it."""
        terminal = PseudoTerminal(self.link)
        try:
            announce(f"load machine on node {servo.node_id}: serial port {terminal.name}")
            brake = Brake(Shaft(servo), self.torque_max_nm)
            yield InstrumentAtTerminal(Instrument(brake), terminal, self.faults, seed)
        finally:
            terminal.unplug()
