"""Getting to know a drive in guided steps: ``hil commission``, ``hil restore``."""
