"""python-can without what it loads beside itself.

Where asammdf is installed (``hil export --to mf4`` takes it), python-can imports it for a log format that
nothing here reads or writes, and with it pandas and polars: 0.4 s and 100 MB of every process.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from types import ModuleType

_READER = "can.io.mf4"


class _NotForPythonCan(MetaPathFinder):
    """Says no to python-can alone: whoever else imports asammdf gets it."""

    def find_spec(self, name: str, *_: Sequence[str] | ModuleType | None) -> None:
        if name == "asammdf":
            reader = sys.modules.get(_READER)
            if reader is not None and getattr(reader.__spec__, "_initializing", False):
                raise ModuleNotFoundError(f"{_READER} is spared {name}", name=name)


def spare_asammdf() -> None:
    """From now on; ``can.MF4Reader`` of this process then says that asammdf is missing."""
    sys.meta_path.insert(0, _NotForPythonCan())
