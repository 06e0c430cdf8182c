"""The members of the swarm that need no processes, as the functions of a campaign: swarm.toml.

A bench is drawn from a seed, with nodes on its bus that it does not know; its run is held against what must
be true of every run, by witnesses inside the drives and by the frames on the wire.
"""

import json
import signal
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from servobench import Run
from servobench.hil.rows.run_files import FRAMES_FILE
from tests.scenario.foreign_node import beside_the_bench
from tests.swarm.cases import EXAMPLES, tables
from tests.swarm.invariants import OF_RECORDINGS, OF_RUNS, held_against
from tests.swarm.mishaps import circumstances
from tests.swarm.ran import Member, Told
from tests.swarm.witness import DriveWitness, witnessed

BASE: Final = dict.fromkeys(tomllib.loads((EXAMPLES / "ling2012.toml").read_text(encoding="utf-8")))
"""The tables of the sweep's bench: none of them is left."""
PROCESSOR_S_MAX: Final = 60.0
"""A run takes a tenth of a second. One that never ends kills its worker, and the campaign names it."""


def changes(seed: int) -> dict[str, Any]:
    """A whole bench."""
    return {**BASE, **tables(seed)}


def check(seed: int, run: Callable[[], Run]) -> list[str]:
    """What the run does not hold, by name."""
    drawn = tables(seed)
    around = circumstances(seed, drawn["bench"]["duration_s"], len(drawn["drive"]))
    drives: list[DriveWitness] = []
    signal.setitimer(signal.ITIMER_PROF, PROCESSOR_S_MAX)
    try:
        with beside_the_bench(*around.strangers), witnessed(drives):
            ran = run()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    folder = Path(ran.summary.recording)
    out = json.dumps(ran.summary.as_json(), allow_nan=False)
    told = Told(ran.verdict.exit_status, out, "", [drive.testimony() for drive in drives])
    member = Member(ran.config, around, folder, told, run=ran)
    recorded = (folder / FRAMES_FILE).exists()
    return held_against((*OF_RUNS, *(OF_RECORDINGS if recorded else ())), member)
