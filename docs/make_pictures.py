"""The pictures of pages in docs/ anew, out of the folders of ``make pictures`` and of its long runs:

python -m tests.pictures --out build/pictures
python -m tests.benchmarks.bench_pictures --out build/pictures
python docs/make_pictures.py build/pictures
"""

import argparse
from pathlib import Path

from PIL import Image

SIZE = (1280, 720)
COLORS = 160
"""Lines and texts on one dark background need no more, and a picture takes 50 to 130 kB."""
PICTURES = {
    "passed-2s": "run-review",
    "broken-speed_error_peak_percent": "run-not-passed",
    "fault-bus_off": "run-bus-off",
    "60min-3axes": "run-an-hour",
    "live": "run-live",
    "comparison": "run-comparison",
    "position": "run-position",
    "commissioning": "commissioning-page",
    "campaign": "campaign-page",
}
"""By the name that it is drawn with."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Put pictures of pages into docs/, smaller.")
    parser.add_argument("folder", type=Path, help="with the pictures")
    folder: Path = parser.parse_args().folder
    for drawn, name in PICTURES.items():
        if (folder / f"{drawn}.png").exists():
            with Image.open(folder / f"{drawn}.png") as picture:
                small = picture.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
            # By octree: the median cut takes a thin blue line and a thin green one for one colour, and by
            # coverage the ground turns brown.
            small.quantize(COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
                Path(__file__).parent / f"{name}.png", optimize=True
            )
            print(f"docs/{name}.png")


if __name__ == "__main__":
    main()
