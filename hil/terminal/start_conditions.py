"""Preconditions of every command; if one fails, the command says so and changes nothing."""

import os
import resource
import sys
from typing import Final

from servobench.hil.terminal.run_object import not_begun
from servobench.hil.verdict.verdict import ExitStatus

ADDRESS_SPACE_KB_MIN: Final = 450_000
"""A run with simulated drives and without a recording maps 430 MB (x86-64, Python 3.11). At some limits below
that OpenBLAS neither loads nor fails: it requests memory for ever."""


def refuse_to_begin() -> None:
    """Leave with one line on stderr, and the object of ``hil run --json``, if a precondition fails."""
    trouble = _gone_folder() or _little_memory()
    if trouble is not None:
        print(f"hil: error: {trouble}", file=sys.stderr)
        not_begun(ExitStatus.BAD_INPUT, trouble)
        sys.exit(ExitStatus.BAD_INPUT)


def _gone_folder() -> str | None:
    try:
        os.getcwd()
    except OSError as error:
        return f"the current folder: {error.strerror}; change into a folder that is there"
    return None


def _little_memory() -> str | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= ADDRESS_SPACE_KB_MIN << 10:
        return None
    return f"ulimit -v: found {limit >> 10}, expected {ADDRESS_SPACE_KB_MIN} or more [kB], or unlimited"
