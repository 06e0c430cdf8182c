"""Some mutants of every kind of file; more of them: ``make swarm``."""

from pathlib import Path

import pytest

from tests.mutants.kinds import KINDS
from tests.mutants.mutant import Kind, failures

MUTANTS = 9
"""Of each kind of file."""


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_mutated_file_is_loaded_or_refused(kind: Kind, tmp_path: Path) -> None:
    path = tmp_path / kind.name
    path.write_bytes(kind.sound)
    kind.load(path)  # the sound one is
    assert [text for number in range(MUTANTS) for text in failures(kind, number, path)] == []
