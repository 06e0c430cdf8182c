"""The bench: loop, timing, recording, review, commissioning, campaigns, and the command ``hil``."""
