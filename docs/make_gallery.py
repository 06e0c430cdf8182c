"""Draw docs/gallery anew, a run of each bench in examples/: ``python docs/make_gallery.py [NAME...]``."""

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/gallery"
SIZE = (720, 640)
COLORS = 32


def main() -> None:
    """Command line."""
    names = sys.argv[1:] or sorted(path.stem for path in (ROOT / "examples").glob("*.toml"))
    for name in names:
        with tempfile.TemporaryDirectory() as scratch:
            drawn = Path(scratch) / "run.png"
            _hil("run", f"examples/{name}.toml", "--record", f"{scratch}/run", may_fail=True)
            _hil("picture", f"{scratch}/run", str(drawn), "--paper")
            with Image.open(drawn) as picture:
                small = picture.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
        small.quantize(COLORS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            PICTURES / f"{name}.png", optimize=True
        )
        print(f"docs/gallery/{name}.png")


def _hil(*words: str, may_fail: bool = False) -> None:
    """Run a command; one of the examples is there to fail."""
    subprocess.run(
        [sys.executable, "-m", "servobench.hil.cli", *words],
        cwd=ROOT, check=not may_fail, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


if __name__ == "__main__":
    main()
