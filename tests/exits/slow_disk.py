"""A recorder on a disk that can be made slow: ``python -m tests.exits.slow_disk MODULE FLAG ...``.

While the file FLAG is there, each write takes WRITE_NS.
"""

import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from servobench.hil.rows.records_file import RecordsWriter

WRITE_NS: Final = 100 * NS_PER_MS


def slowed(write: Callable[..., Any], flag: Path) -> Callable[..., Any]:
    """``write``, which takes long while ``flag`` is there."""
    clock = MonotonicClock()

    def slow(*given: Any) -> Any:
        if flag.exists():
            clock.sleep_until(Instant(clock.now() + WRITE_NS))
        return write(*given)

    return slow


def main() -> None:
    """Run the recorder."""
    _, module, flag, *arguments = sys.argv
    os.pwrite = slowed(os.pwrite, Path(flag))
    RecordsWriter.write = slowed(RecordsWriter.write, Path(flag))  # type: ignore[method-assign]
    sys.argv[1:] = arguments
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
