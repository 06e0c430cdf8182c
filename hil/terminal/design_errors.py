"""A design that cannot be had, as the bad input that it is for somebody who typed a command."""

from collections.abc import Iterator
from contextlib import contextmanager

from servobench.design.errors import DesignError
from servobench.drivers.errors import BenchError


class DesignRefused(BenchError):
    """The assumption or demand that failed, its figures, and what to do: in the design's own words."""

    exit_status = 2


@contextmanager
def refused(about: str) -> Iterator[None]:
    """Raises DesignRefused, which begins with ``about``, for a DesignError inside."""
    try:
        yield
    except DesignError as error:
        raise DesignRefused(f"{about}: {error}") from error
