"""Runs of whole benches for tests: a bench file, the test's changes, and the bus of the test."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BenchError
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.bench_file import Bench, PathLike, load_faults
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.configuration.references import SignalFile
from servobench.hil.execution.bench import run_bench
from servobench.hil.loop.protocol import Controller
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.testing.hosted import DriveHost, DriveWish
from servobench.hil.testing.run import Run
from servobench.hil.verdict.verdict import VerdictKind


class BenchRunner:
    """The fixture ``servo_bench``: call it with a bench to run it."""

    def __init__(self, bus: str, host: DriveHost, scratch: Path, folder: Path) -> None:
        """``folder``: start of paths in a bench that is no file."""
        self.bus = bus
        """SPEC of the bus for the runs."""
        self._host = host
        self._scratch = scratch
        self._folder = folder
        self._numbers = itertools.count(1)

    def load(
        self,
        bench: PathLike | Mapping[str, Any],
        changes: Mapping[str, Any] | None = None,
        *,
        faults: PathLike | Mapping[str, Any] | None = None,
        motor: PathLike | MotorFile | None = None,
    ) -> BenchConfig:
        """Load and check a bench: a file, or its tables; see :meth:`__call__`. Raises BadInput or
        BadInputs."""
        read = Bench(bench, folder=self._folder) if isinstance(bench, Mapping) else Bench.load(bench)
        changed = read.changed(changes or {})
        parts: dict[str, Any] = {}
        if motor is not None:
            named = motor.tables if isinstance(motor, MotorFile) else str(Path(motor).absolute())
            parts = {f"drive.{axis}.motor": named for axis in changed.tables.get("drive", {})}
        if isinstance(faults, Mapping):
            parts["faults"] = dict(faults) or None
        config = changed.changed(parts).config
        if faults is not None and not isinstance(faults, Mapping):
            plan = load_faults(Path(faults), NamedBy("faults", "", str(faults)))
            config = config.model_copy(update={"faults": plan})
        return config

    def __call__(
        self,
        bench: PathLike | Mapping[str, Any],
        changes: Mapping[str, Any] | None = None,
        *,
        faults: PathLike | Mapping[str, Any] | None = None,
        motor: PathLike | MotorFile | None = None,
        seed: int | None = None,
        time: str | None = None,
        controllers: Mapping[str, Controller] | None = None,
        ends_in: type[BenchError] | None = None,
    ) -> Run:
        """Run a bench on the bus of this test, and return its recording.

        ``bench``: the path of a bench file, or its tables. ``changes``: values for dotted keys of it, e.g.
        ``{"loop.deadline_us": 1500}``; missing keys are added. ``faults``: a plan in place of the bench's, as
        the path of a plan or of a recorded faults.arrow, or as tables; ``{}``: none. ``motor``: for every
        drive. ``time``: "real" paces a simulated bus. ``controllers``: by axis, an object of the test in
        place of the controller that the bench describes.

        On a bus in real time the drives that no fixture has put there are started as processes. An error
        that ends the run is raised, unless it is of the kind ``ends_in``; then the run is returned with it,
        and it is an AssertionError if the run does not end so.
        """
        __tracebackhide__ = True
        config = self.load(bench, changes, faults=faults, motor=motor)
        spec = parse_bus_spec(self.bus, "servo_bus")
        if not spec.simulated:
            self._put_drives_on_the_bus(config)
        run = Run(config, self._scratch / f"run-{next(self._numbers)}")
        interrupted = False
        try:
            summary = run_bench(
                config,
                bus_spec=self.bus,
                time=time,
                seed=seed,
                record=run.folder,
                controllers=controllers,
                privileged=False,  # a locked memory of pytest is too much to ask of any machine
            )
            interrupted = bool(summary.verdict.of(VerdictKind.INTERRUPTED))
        except Interrupted:
            interrupted = True
        except BenchError as error:
            if ends_in is None or not isinstance(error, ends_in):
                error.add_note(f"recording: {run.folder}")
                raise
            run.error = error
        if interrupted:
            raise KeyboardInterrupt  # whoever stops pytest means all of it, not this run
        if ends_in is not None and run.error is None:
            expected = ends_in.__name__
            raise AssertionError(
                f"the run ended without an error, {expected} expected\nrecording: {run.folder}"
            )
        return run

    def _put_drives_on_the_bus(self, config: BenchConfig) -> None:
        loads = {
            config.drive[axis].node: entry.path
            for axis, entries in config.load.items()
            for entry in entries
            if isinstance(entry, SignalFile) and axis != config.load_machine_axis
        }
        missing = [drive for drive in config.drive.values() if self._host.missing([drive.node])]
        while missing:
            motor = missing[0].motor
            nodes = [drive.node for drive in missing if drive.motor == motor]
            missing = [drive for drive in missing if drive.motor != motor]
            wish = DriveWish(motor=motor, seed=config.bench.seed, bitrate_bit_s=config.bus.bitrate_bit_s)
            self._host.start(nodes, wish, {node: path for node, path in loads.items() if node in nodes})
