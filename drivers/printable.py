"""Makes foreign text safe for a terminal: no character in it may act there."""

import unicodedata

_ACTING = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories: control, format (direction of writing among them), surrogate, private, unassigned, and
the separators of lines and paragraphs."""


def printable(text: str) -> str:
    """Return ``text`` with every character that a terminal would obey, or could not show, as ``\x1b``."""
    if text.isprintable():
        return text
    return "".join(_escaped(sign) if unicodedata.category(sign) in _ACTING else sign for sign in text)


def _escaped(sign: str) -> str:
    return sign.encode("unicode_escape").decode("ascii")
