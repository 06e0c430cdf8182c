"""Real data sheets, where the machine has them beside the project; python canopen's reader is the oracle."""

import io
from pathlib import Path

import canopen.objectdictionary as od
import pytest
from canopen.objectdictionary.eds import import_eds

from servobench.drivers.sheets.dictionary import load_dictionary
from servobench.drivers.sheets.fitness import assess
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE

FOLDER = Path(__file__).parents[4] / "shared" / "eds"
FILES = (
    sorted(path for path in FOLDER.glob("*") if path.suffix in (".eds", ".dcf")) if FOLDER.is_dir() else []
)
NODE = 5
_ATTRIBUTES = ("name", "data_type", "access_type", "pdo_mappable", "default")

pytestmark = pytest.mark.skipif(not FILES, reason="no vendors' data sheets on this machine")


def variables(dictionary: od.ObjectDictionary) -> dict[tuple[int, int], od.ODVariable]:
    found = {}
    for index, entry in dictionary.items():
        members = {0: entry} if isinstance(entry, od.ODVariable) else entry.subindices
        found.update({(index, sub): member for sub, member in members.items()})
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem[:24])
def test_every_file_is_read_as_the_oracle_reads_it(path: Path) -> None:
    ours = variables(load_dictionary(path, NODE).dictionary)
    text = path.read_bytes().decode("latin-1")
    theirs = variables(import_eds(io.StringIO(text), NODE))  # type: ignore[no-untyped-call]
    assert ours.keys() == theirs.keys()
    for key, variable in ours.items():
        for attribute in _ATTRIBUTES:
            mine, other = getattr(variable, attribute), getattr(theirs[key], attribute)
            if isinstance(mine, int) and isinstance(other, int):
                other = mine if (mine - other) % 2**32 == 0 else other  # it does not fold signed values
            assert mine == other or (mine is None and other in ("", b"")), (key, attribute)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem[:24])
def test_every_file_is_assessed(path: Path) -> None:
    found = assess(load_dictionary(path, NODE), NODE, tuple(QUANTITY_OF_MODE))
    assert found.serves == ("605.3150" not in path.name), found.obstacles
    assert found.pdos
    assert found.profile in (402, None)
