"""The tests, and the commands that hold the product against what was drawn at random or measured."""

import os

# before numpy is imported, as in servobench.hil.cli: the matrices are small, a second thread costs more than
# it saves, and on a machine that is busy an exponential of a matrix took twenty times as long with it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
