"""What the process tells its caller, and how an error becomes that."""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

import typer

from drivers.errors import BenchError
from drivers.printable import printable


class ExitStatus(IntEnum):
    """Exit statuses of ``hil``."""

    PASSED = 0
    FAILED = 1
    """The run ended, and its verdict is not passed."""
    BAD_INPUT = 2
    """A file or an option cannot be used; nothing was started."""
    PEER_FAULT = 3
    """The bus or a drive failed, or a safety limit stopped the run."""
    NOT_RECORDED = 5
    """The run is not, or not wholly, recorded."""
    DEFECT = 70
    """An error of this program (EX_SOFTWARE of sysexits.h): never to be taken for a verdict."""
    INTERRUPTED = 130
    """Ctrl-C, SIGTERM or SIGHUP: whatever was found until then is no verdict (128 + SIGINT)."""


def status_of_run(*, passed: bool, interrupted: bool, recorded: bool = True) -> ExitStatus:
    """Of a run that has ended without an error."""
    if interrupted:
        return ExitStatus.INTERRUPTED
    if not recorded:
        return ExitStatus.NOT_RECORDED
    return ExitStatus.PASSED if passed else ExitStatus.FAILED


@contextmanager
def reported_errors() -> Iterator[None]:
    """Print what goes wrong inside on stderr and leave with its exit status."""
    try:
        yield
    except BenchError as error:
        raise typer.Exit(complain(error)) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise typer.Exit(ExitStatus.INTERRUPTED) from None
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except Exception:  # noqa: BLE001 - top of the process: a defect must not leave with the status of a verdict
        traceback.print_exc()
        raise typer.Exit(ExitStatus.DEFECT) from None


def complain(error: BenchError) -> int:
    """Print the error on stderr; the exit status that it asks for."""
    print(error_text(error), file=sys.stderr)
    return error.exit_status


def error_text(error: BenchError) -> str:
    """The error as a user reads it: one line, or one line for each of several."""
    lines = [printable(line) for line in str(error).split("\n")]
    if len(lines) == 1:
        return f"hil: error: {lines[0]}"
    return "\n".join([f"hil: {len(lines)} errors:", *(f"  {line}" for line in lines)])
