"""H-infinity current controllers: ``hil design current``."""
