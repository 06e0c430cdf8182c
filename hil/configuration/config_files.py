"""Reading of TOML files: what cannot be read is a bad input that names the file and the line."""

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict

from drivers.errors import MISSING, BadInput

SIZE_MAX_BYTES = 4_000_000
"""Far beyond any bench file; a recording given by mistake is not read into memory."""


class Section(BaseModel):
    """A table of a file of the bench: immutable, no key unknown, no silent conversion, no nan."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True
    )


class NamedBy(NamedTuple):
    """The place that names a file: the one to blame if there is no such file."""

    source: str
    """A file, or a command-line option."""
    key: str
    """Its key; empty for an option."""
    text: str
    """What stands there."""


def read_toml(path: Path, what: str, named_by: NamedBy | None = None) -> dict[str, Any]:
    """The table in the file ``path``; ``what``: the kind of file, for the message. Raises BadInput."""
    named_by = named_by or NamedBy(str(path), "", "")
    try:
        if path.stat().st_size > SIZE_MAX_BYTES:
            raise BadInput(str(path), "", f"{path.stat().st_size} bytes", f"a {what}, a short TOML file")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise _no_such_file(path, what, named_by) from None
    except OSError as error:
        found = error.strerror or str(error)
        raise BadInput(named_by.source, named_by.key, found, f"a readable {what}", f"see {path}") from None
    except UnicodeDecodeError as error:
        raise BadInput(str(path), f"byte {error.start}", error.reason, "a TOML file in UTF-8") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _no_toml(path, text, str(error)) from None


def require_file(path: Path, what: str, named_by: NamedBy | None = None) -> None:
    """Raises BadInput if there is no file ``path``, as :func:`read_toml` would."""
    if not path.is_file():
        raise _no_such_file(path, what, named_by or NamedBy(str(path), "", ""))


def _no_such_file(path: Path, what: str, named_by: NamedBy) -> BadInput:
    siblings = (
        [item.name for item in path.parent.glob(f"*{path.suffix or '.toml'}")] if path.parent.is_dir() else []
    )
    near = difflib.get_close_matches(path.name, siblings, n=1, cutoff=0.5)
    remedy = f"no file {path}"
    if near:
        remedy += f"; did you mean {path.parent / near[0]}?"
    elif siblings:
        remedy += f"; that folder holds {', '.join(sorted(siblings)[:6])}"
    elif not path.parent.is_dir():
        remedy += "; there is no such folder"
    return BadInput(named_by.source, named_by.key, named_by.text or MISSING, f"the path of a {what}", remedy)


def _no_toml(path: Path, text: str, message: str) -> BadInput:
    place = re.search(r"line (\d+)", message)
    line = int(place.group(1)) if place else len(text.splitlines())
    lines = text.splitlines()
    found = lines[line - 1].strip() if 0 < line <= len(lines) else ""
    return BadInput(str(path), f"line {line}", found, "valid TOML", message)
