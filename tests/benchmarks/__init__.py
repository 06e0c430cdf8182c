"""Commands that print figures; they assert nothing about time."""

import os

# before numpy is imported, as in hil.cli: for small matrices more threads take longer than one
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
