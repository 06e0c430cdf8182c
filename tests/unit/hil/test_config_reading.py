"""Bench files that cannot be read are named, with what was expected."""

from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import load_bench


@pytest.mark.parametrize(
    ("content", "key", "expected"),
    [
        (b"[bench\nname = 1\n", "line 1", "valid TOML"),
        (b"[bench]\nname = 'a'\nname = 'b'\n", "line 3", "valid TOML"),
        (b"\xff\xfe", "", "UTF-8"),
    ],
)
def test_a_file_that_is_no_toml(tmp_path: Path, content: bytes, key: str, expected: str) -> None:
    path = tmp_path / "bench.toml"
    path.write_bytes(content)
    with pytest.raises(BadInput) as caught:
        load_bench(path)
    assert caught.value.source == str(path)
    assert caught.value.key in {key, "byte 0"}
    assert expected in caught.value.expected


def test_a_bench_file_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "bench1.toml").touch()
    with pytest.raises(BadInput) as caught:
        load_bench(tmp_path / "bench.toml")
    assert "bench1.toml" in str(caught.value)
    with pytest.raises(BadInput):
        load_bench(tmp_path)
