"""python-can without the packages that it would load in passing.

Where asammdf is installed (``hil export --to mf4`` takes it), python-can imports it for a log format that
hardly any process reads, and with it pandas and polars: 0.4 s and 100 MB of every process.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any

_READER = "can.io.mf4"


class _NotForPythonCan(MetaPathFinder):
    """Hides asammdf from python-can alone: any other importer gets it."""

    def find_spec(self, name: str, *_: Sequence[str] | ModuleType | None) -> None:
        if name == "asammdf":
            reader = sys.modules.get(_READER)
            if reader is not None and getattr(reader.__spec__, "_initializing", False):
                raise ModuleNotFoundError(f"{_READER} is spared {name}", name=name)


def spare_asammdf() -> None:
    """Stop python-can from importing asammdf; ``can.MF4Reader`` then reports it as missing in this
    process, :func:`mf4_reader` does not."""
    sys.meta_path.insert(0, _NotForPythonCan())


def mf4_reader() -> Any:
    """Return python-can's class that reads mf4, with asammdf.

    Raises ModuleNotFoundError if that is not installed.
    """
    import_module("asammdf")
    import_module(_READER)
    spec = find_spec(_READER)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.MF4Reader
