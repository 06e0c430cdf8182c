"""Whether the compiled forms of the hot modules are there, and were made from the present sources.

A compiled module shadows its source. One that is older than its source would run what nobody reads any
more, so its build notes the digest of each source, and each start compares them.
"""

import json
from collections.abc import Iterable
from hashlib import blake2b
from pathlib import Path

from drivers.errors import BadInput

MANIFEST = "drivers/compiled.json"
"""Below the checkout: source -> digest, written when a build in place is complete."""
LIBRARY = "compiled__mypyc*"
ROOT = Path(__file__).parents[2]
ADVICE = "make compile, or make pure to run interpreted"


def digest_of(source: Path) -> str:
    """What tells one version of a source from another."""
    return blake2b(source.read_bytes(), digest_size=16).hexdigest()


def compiled_modules(root: Path = ROOT) -> dict[str, str]:
    """The sources of the compiled modules, with the digests they had; empty if all is interpreted."""
    manifest = root / MANIFEST
    if manifest.exists():
        sources: dict[str, str] = json.loads(manifest.read_text())
        return sources
    if any((root / MANIFEST).parent.glob(LIBRARY)):
        return {MANIFEST: "a build that was not completed"}
    return {}


def stale_modules(root: Path = ROOT, wanted: Iterable[str] = ()) -> list[str]:
    """Compiled modules whose sources have changed since, and those of ``wanted`` that are not compiled."""
    compiled = compiled_modules(root)
    stale = [
        name
        for name, digest in compiled.items()
        if not (root / name).exists() or digest_of(root / name) != digest
    ]
    wanted = frozenset(wanted)
    if wanted:
        stale += sorted(wanted.symmetric_difference(compiled))
    return stale


def require_fresh(root: Path = ROOT) -> None:
    """Raises BadInput if a compiled module is older than its source."""
    stale = stale_modules(root)
    if stale:
        expected = "ones made from the present sources"
        raise BadInput("the compiled modules", "", ", ".join(stale), expected, ADVICE)
