"""What came of a drawn run, and what must be so of each."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from servobench.hil.configuration.config import BenchConfig
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import ExitStatus
from tests.truth.rows import MISSED, NOT_SENT

STATUSES: Final = (
    ExitStatus.PASSED,
    ExitStatus.FAILED,
    ExitStatus.PEER_FAULT,
    ExitStatus.NOT_TRUSTWORTHY,
)
WHYS: Final = ("takes no frames", "dropped", "too late for it")
"""Where echoes were dropped every other SYNC waits for one."""


@dataclass(slots=True)
class Outcome:
    """What came of a run."""

    seed: int
    passed: bool = False
    status: int | None = None
    reason: str = ""
    rows: int = 0
    missed: int = 0
    not_sent: int = 0
    due_at: list[int] = field(default_factory=list)
    """Each row's, ns."""
    no_room: int = 0
    """Rows for whose SYNC a flood left no room in time, whoever would have offered it."""
    refused: int = 0
    """Rows whose SYNC a sender would not have got rid of that offers it once, when it is due."""
    wrong: list[str] = field(default_factory=list)
    """What it did not hold, in words."""

    def take(self, summary: Summary, rows: Rows, events: Sequence[str]) -> None:
        """Figures of a run, and what must be true of them whatever befell it."""
        verdict, wrong = summary.verdict, self.wrong
        self.passed, self.status, self.rows = verdict.passed, verdict.exit_status, rows.size
        self.reason = verdict.reason
        self.missed = int((rows["fate"] == MISSED).sum())
        self.due_at = rows["due_at"].tolist()
        self.not_sent = int((rows["command_fate"] == NOT_SENT).sum())
        if verdict.exit_status not in STATUSES:
            wrong.append(f"status {verdict.exit_status}: {verdict.reason}")
        if verdict.passed and not verdict.completed:
            wrong.append("passed, and not completed")
        # A run that an error ends does not count the cycles for which its host was late.
        asked = self.not_sent + (self.missed if verdict.completed else 0)
        if asked and not any(why in text for text in events for why in WHYS):
            wrong.append("cycles without frames, and no event tells why")

    def judge_share(self, config: BenchConfig, came: int) -> None:
        """``came``: readings that were there by their deadline, as others saw them."""
        percent = 100.0 * (self.rows - came) / max(self.rows, 1)
        limit = config.verdict.limits.dropouts_percent_max
        if self.passed and limit is not None and percent > limit:
            self.wrong.append(f"passed with {percent:.2f} % of the readings missing, {limit} % allowed")
