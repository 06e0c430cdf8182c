"""References from files: what is read, how it is asked for between two rows, and what is refused."""

import bisect
import tomllib
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config_files import bad_inputs_of
from servobench.hil.configuration.references import load_signal
from servobench.hil.execution.assembly import reference_profile
from servobench.hil.loop.scenario import Quantity, Table

EXAMPLES = Path(__file__).parents[3] / "examples"


def written(path: Path, columns: dict[str, list[float]]) -> Path:
    if path.suffix == ".parquet":
        parquet.write_table(pa.table(columns), path)
    else:
        rows = zip(*columns.values(), strict=True)
        lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
        path.write_text("\n".join(lines) + "\n")
    return path


def raw_bench(name: str, path: Path, **more: Any) -> dict[str, Any]:
    raw = tomllib.loads((EXAMPLES / name).read_text())
    raw["reference"] = {"axis1": [{"kind": "file", "path": str(path), **more}]}
    raw.pop("verdict", None), raw.pop("load", None)
    return raw


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_columns_by_name_with_their_units(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"a{suffix}", {"note": [7, 8], "speed_rpm": [0.0, 60.0], "time_s": [0.5, 1.5]})
    found = load_signal(path)
    assert (found.quantity, list(np.frombuffer(found.times_s))) == (Quantity.SPEED, [0.5, 1.5])
    assert list(np.frombuffer(found.levels)) == pytest.approx([0.0, 60.0 * RAD_S_PER_RPM])
    config = bench_from(raw_bench("any_bus.toml", path, at_s=0.25), "bench.toml", EXAMPLES)
    profile = reference_profile(config, "axis1")
    asked = [profile.value(time_s) / RAD_S_PER_RPM for time_s in (0.2, 0.75, 1.25, 1.75, 9.0)]
    assert asked == pytest.approx([0.0, 0.0, 30.0, 60.0, 60.0])
    assert config.reference["axis1"][0].describe() == f"speed of a{suffix}, 2 points"


@pytest.mark.parametrize("held", [True, False])
def test_whatever_is_asked_for_next_the_table_says_the_same_as_a_search(held: bool) -> None:
    random = Random(5)
    times = sorted({random.uniform(0.0, 10.0) for _ in range(300)})
    levels = [random.uniform(-3.0, 3.0) for _ in times]
    table = Table(0.0, np.array(times).tobytes(), np.array(levels).tobytes(), held)
    asked = (
        [random.uniform(-1.0, 11.0) for _ in range(500)] + [0.01 * number for number in range(1100)] + times
    )
    for time_s in asked:
        place = max(0, bisect.bisect_right(times, time_s) - 1)
        flat = held or not times[0] <= time_s < times[-1]
        span_s, rise = (
            (1.0, 0.0) if flat else (times[place + 1] - times[place], levels[place + 1] - levels[place])
        )
        # to the bit: the digest of a run hangs on it
        assert table.value(time_s, 9.9) == levels[place] + (time_s - times[place]) / span_s * rise
        assert table.rate(time_s, 9.9) == rise / span_s


@pytest.mark.parametrize(
    ("columns", "key", "expected"),
    [
        ({"time_s": [0.0, 1.0], "rpm": [0.0, 1.0]}, "columns", "time_s and one of speed_rpm"),
        ({"time_s": [0.0], "speed_rpm": [1.0], "torque_nm": [1.0]}, "columns", "time_s and one of"),
        ({"time_s": [0.0, 1.0, 1.0], "speed_rpm": [0.0] * 3}, "time_s[2]", "more than the row before it, 1"),
        ({"time_s": [0.0, 1.0], "speed_rpm": [0.0, float("nan")]}, "speed_rpm[1]", "a finite number"),
        ({"time_s": [], "speed_rpm": []}, "rows", "1 to"),
    ],
)
def test_a_file_that_is_no_signal(
    tmp_path: Path, columns: dict[str, list[float]], key: str, expected: str
) -> None:
    path = written(tmp_path / "bad.parquet", columns)
    with pytest.raises(BadInput) as caught:
        load_signal(path)
    assert (caught.value.source, caught.value.key) == (str(path), key)
    assert expected in caught.value.expected


@pytest.mark.parametrize(
    ("name", "content"), [("a.txt", "x"), ("none.csv", None), ("b.parquet", "no"), ("c.csv", "")]
)
def test_a_file_that_cannot_be_read(tmp_path: Path, name: str, content: str | None) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(BadInput, match=name):
        bench_from(raw_bench("any_bus.toml", tmp_path / name), "bench.toml", EXAMPLES)


def test_what_the_axis_cannot_take_is_refused_as_of_any_reference(tmp_path: Path) -> None:
    path = written(tmp_path / "p.csv", {"time_s": [0.0, 0.1], "position_rad": [0.0, 90.0]})
    for name, expected in (("any_bus.toml", "a speed: a pid"), ("position_csp.toml", "set_speed_max_rpm")):
        with pytest.raises(Exception, match=r".") as caught:
            bench_from(raw_bench(name, path), "bench.toml", EXAMPLES)
        (found,) = bad_inputs_of(caught.value)  # type: ignore[arg-type]
        assert expected in found.expected
