"""Compiled functions that processes share: numba's cache on the disk, safe where many start together.

numba's own cache ends a program at an index that cannot be read, be it empty or cut short by a crash, a full
disk or a file system whose renaming shows in between; and two processes that compile for different types at
once give both codes the same file. Here the folder is locked to read and to write, and what cannot be read,
or is for other types, is compiled anew.
"""

import fcntl
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.sigutils import normalize_signature

F = TypeVar("F", bound=Callable[..., Any])
_DAMAGED = (
    EOFError,
    pickle.UnpicklingError,
    AttributeError,
    ImportError,
    IndexError,
    KeyError,
    TypeError,
    ValueError,
)
"""What unpickling octets raises that no pickle wrote (documentation of ``pickle.UnpicklingError``)."""


def kept(function: F, **options: Any) -> F:
    """``function`` compiled by numba with ``options`` of ``njit``, typed as the plain function that it is."""
    compiled = numba.njit(**options)(function)
    if isinstance(compiled, Dispatcher):  # NUMBA_DISABLE_JIT leaves the function as it is
        with suppress(
            RuntimeError
        ):  # no folder can be written, here or at home: each process compiles it anew
            cache = _SharedCache(function)  # type: ignore[no-untyped-call]
            cache.counts_references = options.get("_nrt", True)
            cast(Any, compiled)._cache = cache
    return cast(F, compiled)


class _SharedCache(FunctionCache):
    """One function's; a cache that cannot be read or written costs time, never the program."""

    counts_references = True
    """Whether its code counts references to arrays, and so calls what numba sets up for that."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for these types; None if there is none that can be used.

        Code that counts no references is linked as it is. numba's own way would first load all that it
        compiles with, 230 modules and scipy among them: 0.35 s of each start, and 50 MB.
        """
        try:
            with _locked(self.cache_path):
                if self.counts_references:
                    target_context.refresh()
                with self._guard_against_spurious_io_errors():
                    result = self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except (*_DAMAGED, OSError):
            return None
        args, _ = normalize_signature(sig)  # type: ignore[no-untyped-call]
        return result if result is not None and result.signature.args == tuple(args) else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for these types."""
        try:
            os.makedirs(self.cache_path, exist_ok=True)
            with _locked(self.cache_path):
                try:
                    super().save_overload(sig, data)  # type: ignore[no-untyped-call]
                except _DAMAGED:
                    self.flush()  # type: ignore[no-untyped-call]
                    super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError:
            return


_held: set[str] = set()
"""Folders locked by this process. One thread at a time gets here: numba compiles under a lock of its own."""


@contextmanager
def _locked(folder: str) -> Iterator[None]:
    """Alone with the folder, among those that ask this way; loading a function may load one that it calls."""
    if folder in _held:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    _held.add(folder)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        _held.remove(folder)
        os.close(descriptor)
