"""Runs a bench from Python; imports happen at the call."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servobench.hil.configuration.bench_file import Bench
    from servobench.hil.loop.protocol import Controller
    from servobench.hil.machine.progress import Progress
    from servobench.hil.machine.stopping import StopRequest
    from servobench.hil.testing.run import Run


def run(
    bench: "Bench | str | os.PathLike[str] | Mapping[str, Any]",
    changes: Mapping[str, Any] | None = None,
    *,
    record: bool | str | os.PathLike[str] = False,
    seed: int | None = None,
    bus: str | None = None,
    time: str | None = None,
    controllers: "Mapping[str, Controller] | None" = None,
    signals: "Mapping[str, Callable[[float], float]] | None" = None,
    network: str | os.PathLike[str] | None = None,
    allow_uncertified: bool = False,
    stop: "StopRequest | None" = None,
    progress: "Progress | None" = None,
) -> "Run":
    """Run a bench to its end, and return the run, even if it did not pass.

    ``bench``: the path of a bench file, its tables, or a :class:`hil.Bench`. ``changes``: values for dotted
    keys of it, see :meth:`hil.Bench.changed`. ``record``: the folder of the recording, new or empty; True:
    one below ``runs``; False: nothing is written, and all is kept in memory. ``seed``, ``bus``, ``time``
    ("real" paces a simulated bus), ``network``, ``allow_uncertified``: as for ``hil run``. ``controllers``:
    by axis, an object in place of the bench's own. ``signals``: functions of the time in s in place of
    references and loads, e.g. ``{"load.axis1.torque_nm": f}``; they are evaluated for each cycle before
    anything moves, and their values are kept. ``stop``: another thread ends the run by it; in the main thread
    Ctrl-C does, too. ``progress``: called with the phase, and how many seconds are done.

    From any thread; two at once in simulated time alone. Raises BadInput or BadInputs before anything moves,
    PeerFault or RecordingFailed with the drives at rest again and the recording kept.
    """
    from servobench.drivers.errors import BadInput
    from servobench.drivers.wire.adapters import parse_bus_spec
    from servobench.hil.configuration.bench_file import Bench
    from servobench.hil.execution.bench import run_bench
    from servobench.hil.machine.progress import no_progress
    from servobench.hil.recording.recorder import recorder_of
    from servobench.hil.recording.run_recorder import MemoryRecorder
    from servobench.hil.rows.recording_plan import RecordingPlan
    from servobench.hil.testing.run import Run
    from servobench.hil.testing.signals import with_signals

    config = with_signals(Bench.of(bench).changed(changes or {}), signals or {}).config
    if not record and not parse_bus_spec(bus or config.bus.spec, "bus").simulated:
        raise BadInput("run", "record", False, "a folder: on a bus in real time another process records")
    memory: list[MemoryRecorder] = []

    def in_memory(plan: RecordingPlan) -> MemoryRecorder:
        memory.append(MemoryRecorder(plan, keep_all=True))
        return memory[-1]

    summary = run_bench(
        config,
        bus_spec=bus,
        time=time,
        seed=seed,
        record=None if isinstance(record, bool) else Path(record),
        progress=progress or no_progress,
        keep=bool(record),
        controllers=controllers,
        network=None if network is None else Path(network),
        allow_uncertified=allow_uncertified,
        privileged=False,
        stop=stop,
        recording=recorder_of if record else in_memory,
    )
    return Run(config, Path(summary.recording) if record else memory[0], summary=summary)
