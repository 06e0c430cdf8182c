"""What design computes in C; the sources beside this file say how."""

SOURCES_DIGEST: str
"""Of the C that the library was built from (servobench.design.core.build)."""

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
    """The peaks of ``count`` runs from number ``first`` on, as doubles; other threads go on meanwhile.

    ``figures``: doubles, in the order of ``Figures`` in random_runs.h. Error: ValueError for another count of
    them, OverflowError for a seed outside 0 to 2^64 - 1.
    """
