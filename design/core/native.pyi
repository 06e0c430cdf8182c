"""The functions of design computed in C; the sources beside this file document them."""

SOURCES_DIGEST: str
"""Digest of the C sources of the library (servobench.design.core.build)."""

def random_runs(
    seed: int,
    first: int,
    count: int,
    figures: bytes,
    strategy: int,
    losses_max: int,
    behind: int,
    steps: int,
    /,
) -> bytes:
    """Return the peaks of ``count`` runs from number ``first`` on, as doubles; other threads go on meanwhile.

    ``figures``: doubles, in the order of ``Figures`` in random_runs.h. Error: ValueError for another count of
    them, OverflowError for a seed outside 0 to 2^64 - 1.
    """
