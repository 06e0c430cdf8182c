"""What the process tells its caller, and how an error becomes that."""

import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from drivers.errors import BenchError
from drivers.printable import printable
from hil.verdict.verdict import ExitStatus


def _no_more(status: int, _text: str) -> int:
    """Of a command that says nothing but the error."""
    return status


@contextmanager
def reported_errors(conclude: Callable[[int, str], int] = _no_more) -> Iterator[None]:
    """Print what goes wrong inside on stderr and leave with its exit status.

    ``conclude``: told that status and the error in words, right before; the status to leave with.
    """
    try:
        yield
    except BenchError as error:
        raise _leave(complain(error), str(error), conclude) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise _leave(ExitStatus.INTERRUPTED, "interrupted", conclude) from None
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except Exception as error:  # noqa: BLE001 - top of the process: a defect must not leave with the status of a verdict
        traceback.print_exc()
        raise _leave(ExitStatus.DEFECT, f"{type(error).__name__}: {error}", conclude) from None


def _leave(status: int, text: str, conclude: Callable[[int, str], int]) -> typer.Exit:
    return typer.Exit(conclude(status, text))


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
