"""A run in an environment that is not the usual one comes to the same rows.

So many of them as ENVIRONMENTS says, drawn by SEED; 0: all.
"""

import json
import os
import random
import shutil
import subprocess
from typing import Final

import pytest

from tests.unit.hil.recorded_runs import BENCH
from virtual_bus.child_python import python_command

NOT_ROOT: Final = "not root, without a place to write to"
ENVIRONMENTS: Final = {
    "no HOME": 'unset HOME; exec "$@"',
    "HOME is nowhere": 'HOME=/nowhere exec "$@"',
    "TMPDIR is nowhere": 'TMPDIR=/nowhere exec "$@"',
    "ASCII": 'LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 exec "$@"',
    "an odd locale": 'LC_ALL=tr_TR.ISO-8859-9 exec "$@"',
    "no PATH": 'PATH= exec "$@"',
    "umask 777": 'umask 777; exec "$@"',
    "40 files": 'ulimit -n 40; exec "$@"',
    NOT_ROOT: 'HOME=/nowhere exec setpriv --reuid 65534 --regid 65534 --clear-groups "$@"',
}
COUNT: Final = int(os.environ.get("ENVIRONMENTS", "1"))
DRAWN: Final = random.Random(int(os.environ.get("SEED", "36"))).sample(
    sorted(ENVIRONMENTS), COUNT or len(ENVIRONMENTS)
)


def digest(script: str) -> str:
    command = python_command("hil.cli", "run", str(BENCH), "--no-record", "--json")
    shell = ["sh", "-c", script, "sh", *command]
    done = subprocess.run(shell, capture_output=True, text=True, check=False, timeout=100)
    assert "Traceback" not in done.stderr
    table = json.loads(done.stdout)
    assert table["verdict"]["exit_status"] == done.returncode == 0
    return str(table["digest"])


@pytest.mark.parametrize("name", sorted({*DRAWN, NOT_ROOT}))
def test_an_environment_changes_nothing(name: str) -> None:
    if name == NOT_ROOT and (os.getuid() or shutil.which("setpriv") is None):
        pytest.skip("only root can be somebody else")
    assert digest(ENVIRONMENTS[name]) == digest('exec "$@"')
