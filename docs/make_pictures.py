"""The pictures of docs/ anew: ``python docs/make_pictures.py RUN_FOLDER [PICTURE]``; see ``hil picture``."""

import argparse
from pathlib import Path

from hil.recorded.viewer import draw_page


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Draw the page that the recording of a run opens with.")
    parser.add_argument("run", type=Path, help="folder of a run, or its run.rrd")
    parser.add_argument("picture", type=Path, nargs="?", default=Path(__file__).parent / "run-review.png")
    arguments = parser.parse_args()
    arguments.picture.write_bytes(draw_page(arguments.run))
    print(arguments.picture)


if __name__ == "__main__":
    main()
