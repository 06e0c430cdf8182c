"""summary.json of a recording, read."""

from pathlib import Path

from drivers.bounded_file import parse_json, read_text
from drivers.errors import BadInput
from hil.rows.run_files import SUMMARY_FILE
from hil.verdict.plain_values import from_plain
from hil.verdict.summary import Summary

_WHOLE = "a whole summary"


def read_summary(folder: Path) -> Summary:
    """Of the run in ``folder``. Raises BadInput, and of it NoSuchFile."""
    path = folder / SUMMARY_FILE
    plain = parse_json(read_text(path, "summary"), str(path), _WHOLE)
    try:
        return from_plain(Summary, plain)
    except ValueError as error:
        raise BadInput(str(path), "", str(error), _WHOLE) from None
