"""From rows to the files of a run: ring, logger, keepers, the live view, recovery."""

from servobench.drivers.compiled import use_fresh

use_fresh()
