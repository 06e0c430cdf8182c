"""All load machines of a run: found for their drives, attended to, and let go of on every way out."""

from collections.abc import Callable, Sequence
from typing import Any

from drivers.canopen.network import CanopenNetwork
from drivers.cia402.servo import ServoDrive
from drivers.errors import PeerFault
from drivers.instruments.dynamometer import Dynamometer, LoadReading
from drivers.timebase import Instant
from hil.configuration.config import BenchConfig
from hil.load.instrument import InstrumentLoadMachine, Wait, instrument_line
from hil.load.load_machine import ObjectLoadMachine, find_load_machine
from hil.loop.axis_roles import LoadMachine
from hil.recording.recorder import Recorder
from virtual_bus.drive.servo import SimulatedServo

Say = Callable[[str, str], None]
"""Takes a text for the reader and its level."""


class LoadMachines:
    """What puts loads on the shafts of a bench."""

    def __init__(
        self,
        config: BenchConfig,
        network: CanopenNetwork,
        recorder: Recorder,
        servos: Sequence[SimulatedServo],
    ) -> None:
        """``servos``: the drives simulated in this process, in the order of the axes; empty if elsewhere."""
        self._config = config
        self._network = network
        self._recorder = recorder
        self._servos = dict(zip(config.axes, servos, strict=False))
        self._objects: list[ObjectLoadMachine] = []
        self._instrument: InstrumentLoadMachine | None = None

    def find(self, drive: ServoDrive, say: Say) -> LoadMachine | None:
        """The load machine on the shaft of ``drive``, with its load off; None if there is none.

        Raises BadInput if the bench asks for a load that nothing can make, PeerFault if it fails.
        """
        if drive.name == self._config.load_machine_axis:
            return self._connect(drive.name, say)
        wanted = bool(self._config.load.get(drive.name))
        machine = find_load_machine(drive.network, drive.node_id, self._config.source, drive.name, wanted)
        if machine is not None:
            machine.take_off()
            self._objects.append(machine)
        return machine

    @property
    def chore(self) -> Callable[[Instant], None] | None:
        """What is to be done in each cycle; None if there is nothing."""
        return None if self._instrument is None else self._instrument.attend

    def begin(self, at: Instant) -> None:
        """The run's time zero."""
        if self._instrument is not None:
            self._instrument.begin(at)

    def take_off(self, say: Say) -> None:
        """Take every load off and see that it is gone; what fails is said."""
        for machine in self._objects:
            self._try(machine.take_off, say)
        if self._instrument is not None:
            self._try(self._instrument.take_off, say)
            self._instrument.close()

    def figures(self) -> dict[str, Any] | None:
        """For the summary; None without an instrument."""
        return None if self._instrument is None else self._instrument.figures()

    def _connect(self, axis: str, say: Say) -> InstrumentLoadMachine:
        config, clock = self._config, self._network.clock
        assert config.load_machine is not None, "an axis has a load machine, so there is one"
        wanted = config.load_machine
        line = instrument_line(wanted, config.source, clock, self._servos.get(axis), config.bench.seed)
        dynamometer = Dynamometer(line, clock, wanted.dialect, wanted.settings)
        # pumping keeps the heartbeats going, and in simulated time lets the instrument act
        wait = Wait(self._network.pump, clock)
        self._instrument = InstrumentLoadMachine(dynamometer, axis, wait, self._record)
        say(f"{axis}: load machine on {line.name} is {self._instrument.connect()}", "INFO")
        return self._instrument

    def _record(self, axis: str, reading: LoadReading) -> None:
        self._recorder.load(reading.at, axis, reading.torque_nm, reading.speed_rad_s)

    @staticmethod
    def _try(act: Callable[[], None], say: Say) -> None:
        try:
            act()
        except PeerFault as error:
            say(f"the load may still be on: {error}", "ERROR")
