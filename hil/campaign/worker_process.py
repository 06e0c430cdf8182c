"""A worker of a campaign: ``python -m hil.campaign.worker_process``; see :mod:`hil.campaign.pool`."""

import json
import os
import signal
import sys
from typing import Any

from drivers.errors import BenchError
from drivers.timebase import MonotonicClock
from hil.campaign.adaptive import Drawn
from hil.campaign.pool import sweep_at
from hil.campaign.worker import Workshop
from hil.machine.stopping import StopRequest


def main() -> int:
    """Run what is asked for until nothing more comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    said = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what code of one's own prints is no answer

    def tell(what: dict[str, Any]) -> None:
        said.write(json.dumps(what) + "\n")

    try:
        asked = json.loads(sys.stdin.readline())
        workshop = Workshop(sweep_at(asked["sweep"], asked["identity"]), StopRequest())
        tell({"ready": True})
        clock = MonotonicClock()
        for line in sys.stdin:
            for number, drawn in json.loads(line):
                began = clock.now()
                row = workshop.row(number, Drawn(*drawn))
                tell({"row": row, "took_ns": clock.now() - began})
    except BenchError as error:
        notes = "".join(f"; {note}" for note in getattr(error, "__notes__", ()))
        tell({"error": f"{error}{notes}", "status": error.exit_status})
        return error.exit_status
    except BrokenPipeError:
        """Nobody asks any more."""
    return 0


if __name__ == "__main__":
    sys.exit(main())
