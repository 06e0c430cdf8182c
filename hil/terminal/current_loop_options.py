"""The drive's current loop on the command line: measured, from a bench, stated, or the simulated drive's."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from servobench.drivers.errors import MISSING, BadInput
from servobench.hil.terminal.options import given, valued

if TYPE_CHECKING:
    from servobench.hil.configuration.config import BenchConfig
    from servobench.hil.configuration.drive_current_loop import KnownLoop


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentLoopOptions:
    """Source of the current loop: at most one of bench, commissioned drive and bandwidth."""

    bench: Annotated[
        Path | None, valued("--bench", "BENCH.toml", "Bench file with the drive's current loop.")
    ] = None
    axis: Annotated[str | None, valued("--axis", "NAME", "Axis of --bench; needed if it has several.")] = None
    commissioned: Annotated[
        Path | None, valued("--commissioned", "DRIVE.toml", "Drive file written by hil commission.")
    ] = None
    current_bandwidth_hz: Annotated[
        float | None,
        valued(
            "--current-bandwidth-hz",
            "F",
            "Bandwidth of the drive's current loop, instead of --bench; default: the simulated drive's 800.",
            min=1e-3,
        ),
    ] = None

    @property
    def sources(self) -> dict[str, Path | float]:
        """The sources given, by option."""
        return given(self, "bench", "commissioned", "current_bandwidth_hz")

    def known_loop(self) -> "KnownLoop":
        """Return the first-order loop to design for, and its source. Raises BadInput or BadInputs.

        Without any source it is the simulated drive's default.
        """
        from servobench.hil.configuration.drive_current_loop import KnownLoop

        sources = self.sources
        if len(sources) > 1:
            first, second = list(sources)[:2]
            raise BadInput(second, "", str(sources[second]), f"either {first} or {second}")
        if self.axis is not None and self.bench is None:
            raise BadInput("--axis", "", self.axis, "--bench with it")
        if self.bench is not None:
            return _of_bench(self.bench, self.axis)
        if self.commissioned is not None:
            return _of_drive_file(self.commissioned)
        if self.current_bandwidth_hz is not None:
            return KnownLoop(1, self.current_bandwidth_hz, "--current-bandwidth-hz")
        from servobench.hil.configuration.config_axis import Simulation

        return KnownLoop(1, Simulation().current_loop_hz, "the simulated drive, as nothing else is said")


def _of_bench(bench: Path, axis: str | None) -> "KnownLoop":
    loop = loop_of_bench(*bench_axis(bench, axis))
    if loop.order != 1:
        expected = "PI current loops: speed designs know loops of first order"
        remedy = f"--current-bandwidth-hz {loop.bandwidth_hz:.5g} takes it for one, which hil run does not"
        raise BadInput(str(bench), loop.key, f"a loop of order {loop.order}", expected, remedy)
    return loop


def bench_axis(bench: Path, axis: str | None) -> "tuple[BenchConfig, str]":
    """Return the bench, and the axis meant. Raises BadInput or BadInputs."""
    from servobench.hil.configuration.bench_file import load_bench

    config = load_bench(bench)
    if axis is None and len(config.axes) == 1:
        return config, config.axes[0]
    if axis is None or axis not in config.drive:
        expected = f"one of {', '.join(config.axes)}, the axes of {bench}"
        raise BadInput("--axis", "", MISSING if axis is None else axis, expected)
    return config, axis


def loop_of_bench(config: "BenchConfig", axis: str) -> "KnownLoop":
    """Return the loop of the bench's drive. Raises BadInput if it has to be measured first."""
    from servobench.hil.configuration.drive_current_loop import current_loop_of

    loop = current_loop_of(config, axis)
    if loop is None:
        key = f"drive.{axis}.commissioned.current_loop"
        raise _unmeasured(config.source, key, f"the measured loop of a drive on {config.bus.spec}")
    return loop


def _of_drive_file(path: Path) -> "KnownLoop":
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.drive_current_loop import KnownLoop
    from servobench.hil.configuration.drive_file import load_drive_file

    loop = load_drive_file(path, NamedBy("--commissioned", "", str(path))).current_loop
    if loop is None:
        raise _unmeasured(str(path), "current_loop", "the measured loop")
    return KnownLoop(loop.order, loop.bandwidth_hz, f"current_loop.bandwidth_hz of {path}")


def _unmeasured(source: str, key: str, expected: str) -> BadInput:
    remedy = "hil commission measures it in a torque mode; --current-bandwidth-hz states it"
    return BadInput(source, key, MISSING, expected, remedy)
