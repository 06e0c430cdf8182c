"""A worker of a campaign: ``python -m hil.campaign.worker_process``; see :mod:`hil.campaign.pool`."""

import json
import os
import signal
import sys
from typing import Any

from drivers.errors import BenchError
from hil.campaign.worker import Workshop, refusal


def main() -> int:
    """Run what is asked for until nothing more comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    said = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what code of one's own prints is no answer

    def tell(what: dict[str, Any]) -> None:
        said.write(json.dumps(what) + "\n")

    try:
        asked = json.loads(sys.stdin.readline())
        workshop = Workshop.of_sweep(asked["sweep"], asked["identity"])
        tell({"ready": True})
        for line in sys.stdin:
            for answer in workshop.answers(json.loads(line)):
                tell(answer)
    except BenchError as error:
        tell(refusal(error))
        return error.exit_status
    except BrokenPipeError:
        """Nobody asks any more."""
    return 0


if __name__ == "__main__":
    sys.exit(main())
