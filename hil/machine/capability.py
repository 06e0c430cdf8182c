"""What one check of this machine found, and the machine as the checks see it."""

import os
import resource
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple


class CapabilityStatus(StrEnum):
    """Whether the machine can do a thing."""

    OK = "ok"
    LACK = "lack"


class Look(NamedTuple):
    """What one check found."""

    detail: str
    """In a few words."""
    remedy: str = ""
    """The command that mends a lack, or what to do instead; empty if nothing is lacking."""


@dataclass(frozen=True, slots=True)
class Capability:
    """One thing that the machine can or cannot do."""

    name: str
    status: CapabilityStatus
    detail: str
    needed_for: str
    """What of the bench depends on it."""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Machine:
    """The files, limits and environment that the checks read; a test hands in its own."""

    root: Path = Path("/")
    """Where proc, sys, dev, usr and lib are found."""
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    limits: Mapping[int, int] = field(default_factory=lambda: _soft_limits())
    """resource.RLIMIT_* -> soft limit."""
    release: str = field(default_factory=lambda: os.uname().release)
    """The kernel's release, as ``uname -r`` says it."""
    cpu_count: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    """Processors that this process may use."""

    is_root: bool = field(default_factory=lambda: os.geteuid() == 0)
    """Whether commands need no sudo."""

    def path(self, *parts: str) -> Path:
        """A path below the root, e.g. ``path("sys", "class", "net")``."""
        return self.root.joinpath(*parts)

    def text(self, *parts: str) -> str:
        """A small file's text without its last line end; empty if it cannot be read."""
        try:
            return self.path(*parts).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""

    def has_privilege(self, number: int) -> bool:
        """Whether this process has the capability ``number`` of capabilities(7) in effect."""
        for line in self.text("proc", "self", "status").splitlines():
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> number & 1)
        return False

    def program(self, name: str) -> Path | None:
        """The program ``name`` on the search path, as ``which`` finds it below the root."""
        for folder in self.environment.get("PATH", "").split(os.pathsep):
            candidate = self.path(folder.lstrip("/"), name)
            if candidate.is_file() and os.access(candidate, os.X_OK):
                return candidate
        return None


def _soft_limits() -> dict[int, int]:
    kinds = (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK)
    return {kind: resource.getrlimit(kind)[0] for kind in kinds}
