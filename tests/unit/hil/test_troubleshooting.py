"""docs/troubleshooting.md quotes the messages that the source has."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "troubleshooting.md"
ROW = re.compile(r"^\| `([^`]+)` \| (.+?) \| (.+?) \|$", re.MULTILINE)
QUOTED = ROW.findall(PAGE.read_text(encoding="utf-8"))


def _texts(tree: ast.AST) -> Iterator[str]:
    """Every piece of text, but docstrings."""
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def texts() -> str:
    """All texts of the source, each on a line of its own."""
    files = [
        path for room in ("drivers", "virtual_bus", "design", "hil") for path in (ROOT / room).rglob("*.py")
    ]
    found = {text.replace("\n", " ") for path in files for text in _texts(ast.parse(path.read_text("utf-8")))}
    return "\n".join(sorted(found))


def test_the_page_quotes_messages() -> None:
    assert len(QUOTED) >= 40
    assert len({message for message, _, _ in QUOTED}) == len(QUOTED)


@pytest.mark.long
def test_a_quoted_message_is_one_of_the_source() -> None:
    """``expected`` before what was expected comes from BadInput, in front of a text of its own."""
    source = texts()
    for message, _, _ in QUOTED:
        parts = [part.strip().removeprefix("expected ") for part in message.split("...")]
        missing = [part for part in parts if part and part not in source]
        assert missing == [], message
