"""A run on the adapter of :mod:`tests.vcan.adapter` that is struck once its drive turns."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.rows.records import Rows
from servobench.hil.rows.records_file import read_table, rows_of_table
from tests.scenario.processes import EXAMPLES, Observer, in_background, observer, summary_of
from tests.truth.rows import MISSED, USED
from tests.vcan.adapter import ADAPTER
from tests.warm.start import hil

START_LIMIT_S, REST_LIMIT_S, END_LIMIT_S = 120.0, 30.0, 200.0
Strike = Callable[[Observer, int], None]
"""With the command's process."""
TURNING_RAD_S: Final = 20.0
SLOW: Final = Path(__file__).parents[1] / "can" / "slow.toml"


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended."""

    status: int
    said: str
    events: str
    summary: dict[str, Any]
    rows: Rows
    rest_s: float | None
    """From the strike until the drive was at rest, where it was to come to rest."""

    @property
    def missed(self) -> int:
        """Cycles without SYNC."""
        return int((self.rows["fate"] == MISSED).sum())

    @property
    def lost(self) -> int:
        """Cycles with a SYNC and without a reading in time."""
        return int(((self.rows["fate"] != MISSED) & (self.rows["fate"] != USED)).sum())


def struck(
    far: str,
    folder: Path,
    strike: Strike,
    *,
    passes: bool,
    adapter: str = ADAPTER,
    by: Sequence[str] | None = None,
) -> Ended:
    """A run of 6 s at 50 Hz on ``adapter`` that is struck; ``passes``: the drive is to turn on, else to come
    to rest. ``by``: another command than the forked ``hil``."""
    bench, record, rest_s = _bench(folder), folder / "run", None
    command = ["run", str(bench), "--bus", f"socketcan:{adapter}", "--record", str(record)]
    process = in_background([*(hil() if by is None else by), *command])
    with observer(far) as watching:
        watching.until_turning(TURNING_RAD_S, START_LIMIT_S, process)
        struck_at = watching.now()
        strike(watching, process.pid)
        if not passes:
            rest_s = watching.time_to_rest(struck_at, REST_LIMIT_S) / NS_PER_S
        _, said = process.communicate(timeout=END_LIMIT_S)
    summary = summary_of(record)
    assert summary["verdict"]["exit_status"] == process.returncode
    events = [json.loads(line) for line in (record / "events.jsonl").read_text().splitlines()]
    texts = "\n".join(str(event["text"]) for event in events if event.get("text"))
    rows = rows_of_table(read_table(record / "records.arrow"))
    return Ended(process.returncode, said, texts, summary, rows, rest_s)


def _bench(folder: Path) -> Path:
    """The bench of a machine that is late, five times as fast. It and its drive mind a silence of 2 s."""
    text = SLOW.read_text(encoding="utf-8").replace("../../examples", str(EXAMPLES))
    times = ("100_000", "60_000", "90_000"), ("20_000", "12_000", "18_000")
    for slow, quick in (*zip(*times, strict=True), ("duration_s = 3.0", "duration_s = 6.0")):
        assert text.count(slow) == 1
        text = text.replace(slow, quick)
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path
