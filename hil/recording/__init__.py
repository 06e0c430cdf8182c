"""From rows to the files of a run: ring, logger, keepers, the live view, recovery."""

from drivers.compiled import use_fresh

use_fresh()
