"""Some of what ``python -m tests.mutants --seals`` draws."""

from pathlib import Path

from tests.mutants.seals import COMMAND_EACH, seal_breaker

MUTANTS = 60


def test_no_altered_file_of_a_sealed_folder_is_accepted(tmp_path: Path) -> None:
    broken = seal_breaker(tmp_path / "sealed")
    assert COMMAND_EACH < MUTANTS, "some go through a command too"
    assert [text for number in range(MUTANTS) for text in broken(number)] == []
