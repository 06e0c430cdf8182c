"""Begins and saves the pictures of the studies."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl

from servobench.drivers.errors import BadInput

mpl.use("Agg")
import matplotlib.pyplot as plt


@contextmanager
def picture(
    path: Path,
    rows: int = 1,
    columns: int = 1,
    size: tuple[float, float] = (8.0, 5.0),
    *,
    asked_by: str = "--figures",
    **options: Any,
) -> Iterator[Any]:
    """Yield the axes, one or (rows, columns) of them without an axis of length 1, with a grid; saved
    afterwards.

    ``asked_by``: the option. Raises BadInput for a path that cannot be written to.
    """
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", **options)
    for axis in figure.axes:
        axis.grid(alpha=0.3)
    try:
        yield axes
        try:
            figure.savefig(path, dpi=120)
        except (OSError, ValueError) as error:
            expected = f"a .png, .svg or .pdf file that can be written ({error})"
            raise BadInput(asked_by, "", str(path), expected) from None
    finally:
        plt.close(figure)


def draw_all(folder: Path, files: Mapping[str, Callable[[Path], None]]) -> list[Path]:
    """Draw every picture by its name into ``folder``; return the files. Raises BadInput for an impossible
    folder."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput("--figures", "", str(folder), f"a folder ({error.strerror})") from None
    for name, draw in files.items():
        draw(folder / name)
    return [folder / name for name in files]
