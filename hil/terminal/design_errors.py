"""An impossible design reported as bad input to the user who typed the command."""

from collections.abc import Iterator
from contextlib import contextmanager

from servobench.design.errors import DesignError
from servobench.drivers.errors import BenchError


class DesignRefused(BenchError):
    """The failed assumption or demand, its figures, and the remedy: in the design's own words."""

    exit_status = 2


@contextmanager
def refused(about: str) -> Iterator[None]:
    """Raise DesignRefused, which begins with ``about``, for a DesignError inside."""
    try:
        yield
    except DesignError as error:
        raise DesignRefused(f"{about}: {error}") from error
