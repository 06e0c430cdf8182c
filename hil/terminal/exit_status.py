"""Exit statuses of the process, and how errors map to them."""

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from typer import Abort, BadParameter, Exit  # by name: code of the user's may replace what typer has

from servobench.drivers.errors import BenchError
from servobench.drivers.printable import printable
from servobench.hil.machine.extras import missing_extra
from servobench.hil.machine.parent_process import messages, tell_parent
from servobench.hil.machine.refusals import explained, raised_by_own_code
from servobench.hil.terminal.output import say
from servobench.hil.verdict.verdict import ExitStatus


@contextmanager
def reported_errors(
    conclude: Callable[[int, str], int] = lambda status, _text: status, command: str = "this"
) -> Iterator[None]:
    """Print an error from inside on stderr and leave with its exit status.

    ``conclude``: called with that status and the error in words, right before; returns the status to leave
    with.
    ``command``: the words of the command, for an error that it lacks a package.
    """
    try:
        yield
    except BenchError as error:
        raise Exit(_told(error, conclude)) from None
    except KeyboardInterrupt:
        say("interrupted")
        tell_parent(error="interrupted")
        raise Exit(conclude(ExitStatus.INTERRUPTED, "interrupted")) from None
    except (Exception, SystemExit, GeneratorExit) as error:
        # a defect, or code of the user's that calls sys.exit(): neither leaves with the status of a verdict
        if isinstance(error, Exit | Abort | BadParameter) and not raised_by_own_code(error):
            raise
        tell_parent(released=False)
        if known := missing_extra(error, command) or explained(error):
            raise Exit(_told(known, conclude)) from None
        traceback.print_exc(file=messages())
        text = f"{type(error).__name__}: {error}"
        tell_parent(error=text)
        raise Exit(conclude(ExitStatus.DEFECT, text)) from None


def _told(error: BenchError, conclude: Callable[[int, str], int]) -> int:
    say(error_text(error))
    tell_parent(error=str(error))
    return conclude(error.exit_status, str(error))


def end_with(status: int) -> NoReturn:
    """Leave with ``status``: the command has come to its end. The parent is notified, and believes no 0
    otherwise: user code may have replaced ``sys.exit``, or raised the exception that ends a command."""
    tell_parent(concluded={"status": status})
    raise Exit(status)


def error_text(error: BenchError) -> str:
    """Format an error for the user: one line, or one line for each of several."""
    lines = [printable(line) for line in str(error).split("\n")]
    if len(lines) == 1:
        return f"hil: error: {lines[0]}"
    return "\n".join([f"hil: {len(lines)} errors:", *(f"  {line}" for line in lines)])
