"""The moving picture of the README, from Rerun: examples/blackout.toml with its PID, and with a predictor.

python docs/make_blackout.py

It needs a Vulkan driver, and takes a minute or two.
"""

import io
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from servobench import run
from servobench.hil.recorded.viewer import headless_viewer

ROOT = Path(__file__).resolve().parents[1]
BENCH = ROOT / "examples" / "blackout.toml"
CONTROLLERS = {
    "pid": {},
    "predictor": {"drive.axis1.controller": str(ROOT / "examples/controllers/ling2012-predictor.toml")},
}
WINDOW_S, STEP_S, ENDS_S = 0.12, 0.004, 0.22
PAUSE_MS, LAST_MS = 80, 3000
SPEED = (0, 66, 1344, 266)
TORQUE = (0, 504, 1344, 930)
"""Where the two plots are in the viewer's window, px."""
WIDTH, COLORS = 880, 64


def plots(png: bytes) -> Image.Image:
    """Speed above torque, smaller."""
    with Image.open(io.BytesIO(png)) as window:
        parts = [window.convert("RGB").crop(box) for box in (SPEED, TORQUE)]
    both = Image.new("RGB", (parts[0].width, sum(part.height for part in parts)))
    both.paste(parts[0], (0, 0))
    both.paste(parts[1], (0, parts[0].height))
    return both.resize((WIDTH, round(both.height * WIDTH / both.width)), Image.Resampling.LANCZOS)


def main() -> None:
    """Write docs/blackout.gif."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for each, changes in CONTROLLERS.items():
            run(BENCH, changes, record=folder / each, allow_uncertified=True)
        words = ["compare", *(str(folder / each) for each in CONTROLLERS), "--rrd", str(folder / "both.rrd")]
        subprocess.run(
            [sys.executable, "-m", "servobench.hil.cli", *words], stdout=subprocess.DEVNULL, check=True
        )
        frames = []
        with headless_viewer() as viewer:
            viewer.show(folder / "both.rrd")
            viewer.put_cursor(None)
            for number in range(round((ENDS_S - WINDOW_S) / STEP_S) + 1):
                ends = WINDOW_S + number * STEP_S
                viewer.look_at(ends - WINDOW_S, ends)
                frames.append(plots(viewer.picture()))
    palette = frames[-1].quantize(COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    times = [PAUSE_MS] * (len(drawn) - 1) + [LAST_MS]
    out = ROOT / "docs" / "blackout.gif"
    drawn[0].save(out, save_all=True, append_images=drawn[1:], duration=times, loop=0, optimize=True)
    print(out.relative_to(ROOT), out.stat().st_size)


if __name__ == "__main__":
    main()
