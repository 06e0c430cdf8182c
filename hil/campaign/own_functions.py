"""User functions in a campaign: changes to a run's bench, and a check of the run."""

import traceback
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from servobench.drivers.errors import BadInput, BenchError
from servobench.hil.campaign.sweep_file import Own
from servobench.hil.control.own_code import OwnCodeFailed, object_of, source_of
from servobench.hil.machine.held_process import FAILURES, OWN_FILES, held_process, told

EXPECTED: Final = "a function, as MODULE:NAME or FILE.py:NAME beside the sweep file"
T = TypeVar("T")


class OwnFunctions:
    """The functions named by ``[own]`` of a sweep.

    ``changes(seed)`` returns what is changed in the bench, by dotted keys. ``check(seed, run)`` calls
    ``run()`` once, which runs the bench and returns a :class:`hil.Run`; it returns or yields defects in
    words.
    """

    def __init__(self, own: Own, source: Path) -> None:
        """``source``: the sweep file. Runs none of them. Raises BadInput for a missing file."""
        self._source = str(source)
        given = own.model_dump(exclude_none=True)
        self._names = {
            key: str(source.parent / name) if ".py:" in name else name for key, name in given.items()
        }
        self._digests = {key: self._digest(key) for key in self._names}
        self.checks = "check" in self._names

    def changes(self, seed: int) -> dict[str, Any]:
        """Return the changes for the run with ``seed``. Raises BadInput or OwnCodeFailed."""
        if "changes" not in self._names:
            return {}
        # a copy: keys below its tables may be changed further
        return self._called("changes", seed, lambda function: deepcopy(dict(function(seed))))

    def findings(self, seed: int, run: Callable[[], Any]) -> list[str]:
        """Return the findings of the check. Raises BadInput or OwnCodeFailed, and BenchError as ``run``."""
        return self._called("check", seed, lambda function: list(map(str, function(seed, run))))

    def _called(self, key: str, seed: int, call: Callable[[Any], T]) -> T:
        name = self._names[key]
        try:
            function = _function(name, self._digests[key])
        except FAILURES as error:
            raise BadInput(self._source, f"own.{key}", name, EXPECTED, told(error)) from error
        try:
            with held_process():
                return call(function)
        except FAILURES as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            if isinstance(error, BenchError) and last.filename not in OWN_FILES:
                raise  # of its run
            where = f"{Path(last.filename).name}:{last.lineno} in {last.name}"
            raise OwnCodeFailed(f"{name}, seed {seed}: {where}: {told(error)}") from error

    def _digest(self, key: str) -> str:
        try:
            return source_of(self._names[key])[1]
        except ValueError as error:
            raise BadInput(self._source, f"own.{key}", self._names[key], EXPECTED, str(error)) from error


@cache
def _function(name: str, _digest: str) -> Any:
    """Load a function once, and again when its file has changed: in a notebook campaigns follow each
    other."""
    return object_of(name)
