"""pytest plugin of servobench: drives and benches as fixtures. docs/tutorial-pytest.md leads through it.

pytest loads this in every run on a machine with servobench, so nothing else is imported before a test asks
for one of the fixtures.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from hil.testing.bench_runs import BenchRunner
    from hil.testing.drive_rig import DriveRig
    from hil.testing.hosted import DriveHost, DriveProcess

BUS_OPTION = "--servo-bus"
DEFAULT_BUS = "simulated"


class MakeDrive(Protocol):
    """The fixture ``servo_drive``."""

    def __call__(self, **wish: Any) -> "DriveRig":
        """A drive; ``wish``: fields of :class:`hil.testing.drive_rig.DriveWish`."""
        ...


class StartDrive(Protocol):
    """The fixture ``servo_process``."""

    def __call__(self, *nodes: int, **wish: Any) -> "DriveProcess":
        """Drives in one process; ``wish``: see :meth:`hil.testing.hosted.DriveHost.start`."""
        ...


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--servo-bus SPEC``."""
    group = parser.getgroup("servobench", "simulated servo drives")
    group.addoption(
        BUS_OPTION,
        metavar="SPEC",
        default=None,
        help="bus of the tests that choose none: simulated (default), hub, vcan, socketcan:NAME",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line(
        "markers", "servo_bus(*specs): run the test on each of these buses, e.g. 'simulated', 'hub', 'vcan'"
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test for each bus of the marker ``servo_bus``."""
    if "servo_bus" not in metafunc.fixturenames:
        return
    marker = metafunc.definition.get_closest_marker("servo_bus")
    if marker is not None:
        metafunc.parametrize("servo_bus", marker.args, indirect=True)


@pytest.fixture
def servo_bus(request: pytest.FixtureRequest) -> str:
    """SPEC of the bus that the test is on; a SocketCAN interface that is not up skips the test.

    It fails the test if the bus was asked for on the command line, or a folder hides a package of servobench.
    """
    from hil.hidden_rooms import hidden_room

    if (trouble := hidden_room()) is not None:
        pytest.fail(trouble, pytrace=False)
    from drivers.errors import BusDown
    from hil.testing.buses import bus_spec, require_up

    named = request.config.getoption(BUS_OPTION)
    spec = bus_spec(getattr(request, "param", None) or named or DEFAULT_BUS)
    try:
        require_up(spec)
    except BusDown as error:
        if named is not None:
            pytest.fail(str(error), pytrace=False)
        pytest.skip(str(error))
    return spec


@pytest.fixture
def servo_host(servo_bus: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator["DriveHost"]:
    """The drive processes of the test; they end with it."""
    from hil.testing.hosted import DriveHost

    host = DriveHost(servo_bus, tmp_path_factory.mktemp("servo"))
    try:
        yield host
    finally:
        host.end()


@pytest.fixture
def servo_process(servo_bus: str, servo_host: "DriveHost") -> StartDrive:
    """Start simulated drives as a process on a bus in real time, for a master of the test's own.

    ``servo_process(1, 2, motor="motor.toml", faults="plan.toml", eds="vendor.eds", seed=1)``; the motor is
    [Ling2012]'s if none is named.
    """
    if servo_bus == DEFAULT_BUS:
        pytest.fail(
            "servo_process needs a bus in real time: mark the test with servo_bus('hub') or "
            f"run pytest with {BUS_OPTION}",
            pytrace=False,
        )

    def start(*nodes: int, **wish: Any) -> "DriveProcess":
        from hil.configuration.motor_file import LING2012

        return servo_host.start(nodes or (1,), wish.pop("motor", LING2012), **wish)

    return start


@pytest.fixture
def servo_drive(servo_bus: str, servo_host: "DriveHost") -> Iterator[MakeDrive]:
    """Make a simulated drive with a master beside it, on the bus of the test; it is released at the end.

    ``rig = servo_drive(node=1, motor="motor.toml", eds="vendor.eds", faults={"loss": [...]}, seed=1)``
    """
    from hil.testing.drive_rig import DriveWish, drive_rig

    with ExitStack() as stack:
        yield lambda **wish: stack.enter_context(drive_rig(servo_bus, servo_host, DriveWish(**wish)))


@pytest.fixture
def servo_bench(
    servo_bus: str,
    servo_host: "DriveHost",
    tmp_path_factory: pytest.TempPathFactory,
    request: pytest.FixtureRequest,
) -> "BenchRunner":
    """Run a bench on the bus of the test: ``run = servo_bench("bench.toml", {"bench.seed": 7})``."""
    from hil.testing.bench_runs import BenchRunner

    folder = Path(request.path).parent
    return BenchRunner(servo_bus, servo_host, tmp_path_factory.mktemp("bench"), folder)
