"""Some of what ``python -m tests.mutants --seals`` draws, the first of them through a command too."""

from pathlib import Path

import pytest

from tests.draws import ALL
from tests.mutants.seals import seal_breaker

MUTANTS = 60 if ALL else 20

pytestmark = pytest.mark.usefixtures("forked_children")


def test_no_altered_file_of_a_sealed_folder_is_accepted(tmp_path: Path) -> None:
    broken = seal_breaker(tmp_path / "sealed")
    assert [text for number in range(MUTANTS) for text in broken(number)] == []
