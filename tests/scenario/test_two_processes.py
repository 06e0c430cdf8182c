"""``hil run`` and ``hil simulate`` as two processes on the hub."""

from pathlib import Path

import pytest

from tests.scenario.two_processes import TwoProcesses


class TestOnHub(TwoProcesses):
    """On a hub of its own, so that no other test's frames are heard."""

    @pytest.fixture
    def bus_spec(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
        runtime = tmp_path / "runtime"
        runtime.mkdir(mode=0o700)
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
        return "hub:scenario"
