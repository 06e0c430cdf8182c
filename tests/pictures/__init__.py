"""Pictures of every page, of runs of every kind, and what has to be seen in them: ``make pictures``."""
