"""Compiled functions kept on the disk: damaged, mixed up, and read by many processes at once."""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import os
from pathlib import Path
from design.kept_code import kept
def double(x): return x + x
def triple(x): return x + x + x
double, triple = kept(double), kept(triple)

def processes(count):
    started = []
    for _ in range(count):
        started.append(os.fork())
        if not started[-1]:
            hits = double.stats.cache_hits, triple.stats.cache_hits
            values = double(1), double(1.5), triple(1), triple(1.5)
            line = [*values, *(sum(each.values()) for each in hits)]
            os.write(1, (" ".join(map(str, line)) + "\\n").encode())  # at once: the others write too
            os._exit(0)
    assert [os.waitpid(each, 0)[1] for each in started] == [0] * count

def the_one(pattern):
    (path,) = Path(os.environ["NUMBA_CACHE_DIR"]).rglob(pattern)
    return path

processes(1)
the_one("*double*.nbi").write_bytes(b"")
index = the_one("*triple*.nbi")
index.write_bytes(index.read_bytes()[:-20])
processes(4)
processes(1)
whole, real = the_one("*double*.1.nbc"), the_one("*double*.2.nbc")
codes = whole.read_bytes(), real.read_bytes()
whole.write_bytes(codes[1])
real.write_bytes(codes[0])
the_one("*triple*.1.nbc").write_bytes(codes[0][:100])
processes(1)
"""


def test_processes_that_start_together_compile_anew_what_is_damaged_or_not_theirs(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    ended = subprocess.run(
        [sys.executable, str(program)], env=environment, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    lines = [line.rsplit(maxsplit=2) for line in ended.stdout.splitlines()]
    assert [values for values, *_ in lines] == ["2 3.0 3 4.5"] * 7
    hits = [[int(each) for each in counted] for _, *counted in lines]
    assert hits[0] == [0, 0]
    assert hits[5] == [2, 2], "what was damaged is kept again"
    assert hits[6] == [0, 1], "code of other types is no hit"


COUNTED = """
import sys
import numpy
from design.kept_code import kept
def doubled(values):
    for k in range(len(values)): values[k] += values[k]
doubled, values = kept(doubled, _nrt=False), numpy.ones(2)
doubled(values)
print(*values, sum(doubled.stats.cache_hits.values()), "scipy.linalg" in sys.modules)
"""


def test_kept_code_without_references_starts_without_what_numba_compiles_with(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(COUNTED)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    compiled, loaded = (
        subprocess.run(
            [sys.executable, str(tmp_path / "program.py")],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        ).stdout.split()
        for _ in range(2)
    )
    assert compiled == ["2.0", "2.0", "0", "True"]
    assert loaded == ["2.0", "2.0", "1", "False"]
