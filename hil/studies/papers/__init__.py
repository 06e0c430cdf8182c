"""The papers' figures beside ours: ``hil reproduce ling2012``."""
