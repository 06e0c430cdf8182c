"""From rows to the files of a run: ring, logger, keepers, the live view, recovery."""
