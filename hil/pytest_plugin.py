"""pytest plugin of servobench: drives and benches as fixtures. See docs/tutorial-pytest.md.

pytest loads this in every run on a machine with servobench, so nothing else is imported before a test asks
for one of the fixtures.
"""

import itertools
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from servobench.hil.testing.bench_runs import BenchRunner
    from servobench.hil.testing.campaign_runs import CampaignRunner
    from servobench.hil.testing.drive_rig import DriveRig
    from servobench.hil.testing.hosted import DriveHost, DriveProcess

BUS_OPTION = "--servo-bus"
DRIVES_OPTION = "--servo-drives"
RECORD_OPTION = "--servo-record"
DEFAULT_BUS = "simulated"
SIMULATED, PRESENT = "simulated", "present"
_hub_numbers = itertools.count(1)
ONLY_SIMULATED = ("faults", "eds", "store")
"""Options that only a drive made by the plugin can fulfil."""


class MakeDrive(Protocol):
    """The fixture ``servo_drive``."""

    def __call__(self, **wish: Any) -> "DriveRig":
        """Return a drive; ``wish``: fields of :class:`servobench.hil.testing.hosted.DriveWish`."""
        ...


class StartDrive(Protocol):
    """The fixture ``servo_process``."""

    def __call__(self, *nodes: int, **wish: Any) -> "DriveProcess":
        """Return drives in one process; ``wish``: fields of
        :class:`servobench.hil.testing.hosted.DriveWish`."""
        ...


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--servo-bus SPEC``, ``--servo-drives``, ``--servo-record DIR``."""
    group = parser.getgroup("servobench", "simulated servo drives")
    group.addoption(
        BUS_OPTION,
        metavar="SPEC",
        default=None,
        help="bus of tests that do not choose one: simulated (default), hub, vcan, socketcan:NAME",
    )
    group.addoption(
        DRIVES_OPTION,
        choices=(SIMULATED, PRESENT),
        default=SIMULATED,
        help="simulated: start drives on the bus (default); present: use those already on it",
    )
    group.addoption(
        RECORD_OPTION,
        metavar="DIR",
        default=None,
        help="record each run of servo_bench in a folder of DIR named after the test",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        "markers", "servo_bus(*specs): run the test on each of these buses, e.g. 'simulated', 'hub', 'vcan'"
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Generate one test for each bus of the marker ``servo_bus``."""
    if "servo_bus" not in metafunc.fixturenames:
        return
    marker = metafunc.definition.get_closest_marker("servo_bus")
    if marker is not None:
        metafunc.parametrize("servo_bus", marker.args, indirect=True)


def _bus_spec(name: str) -> str:
    """Return a bus SPEC; ``hub`` alone means a private hub, ``vcan`` means socketcan:vcan0."""
    if name == "hub":
        return f"hub:test-{os.getpid()}-{next(_hub_numbers)}"
    return "socketcan:vcan0" if name == "vcan" else name


def _down(spec: str) -> str | None:
    """Say that a SocketCAN interface is not up, with the command that cures it; None if it is up."""
    from servobench.drivers.errors import BusDown
    from servobench.drivers.wire.adapters import SOCKETCAN, link_up_command, socketcan_links

    interface, _, channel = spec.partition(":")
    if interface != SOCKETCAN or any(each.spec == spec and each.usable for each in socketcan_links()):
        return None
    return str(BusDown(f"{channel} is not up", remedy=link_up_command(channel)))


def _uses_present(config: pytest.Config) -> bool:
    return bool(config.getoption(DRIVES_OPTION) == PRESENT)


@pytest.fixture
def servo_bus(request: pytest.FixtureRequest) -> str:
    """Return the SPEC of the test's bus; a SocketCAN interface that is not up skips the test.

    It fails the test if the bus was requested on the command line.
    """
    named = request.config.getoption(BUS_OPTION)
    if _uses_present(request.config):
        if getattr(request, "param", None) is not None:
            pytest.skip("it has a bus of its own, on which no drive is present")
        if named in (None, DEFAULT_BUS):
            pytest.fail(f"{DRIVES_OPTION} {PRESENT} needs {BUS_OPTION} with the drives' bus", pytrace=False)
    spec = _bus_spec(getattr(request, "param", None) or named or DEFAULT_BUS)
    if (trouble := _down(spec)) is not None:
        if named is not None:
            pytest.fail(trouble, pytrace=False)
        pytest.skip(trouble)
    return spec


@pytest.fixture
def servo_host(
    servo_bus: str, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator["DriveHost"]:
    """Manage the drive processes of the test; they end with it."""
    from servobench.hil.testing.hosted import DriveHost

    host = DriveHost(servo_bus, tmp_path_factory.mktemp("servo"), _uses_present(request.config))
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

    if servo_host.present:
        pytest.skip(f"it makes drives of its own, and {DRIVES_OPTION} is {PRESENT}")

    def start(*nodes: int, **wish: Any) -> "DriveProcess":
        from servobench.hil.testing.hosted import DriveWish

        wished = DriveWish(**wish)
        return servo_host.start(nodes or (wished.node,), wished)

    return start


@pytest.fixture
def servo_drive(servo_bus: str, servo_host: "DriveHost") -> Iterator[MakeDrive]:
    """Make a simulated drive with a master beside it, on the bus of the test; it is released at the end.

    ``rig = servo_drive(node=1, motor="motor.toml", eds="vendor.eds", faults={"loss": [...]}, seed=1)``
    """
    from servobench.hil.testing.drive_rig import drive_rig
    from servobench.hil.testing.hosted import DriveWish

    def make(**wish: Any) -> "DriveRig":
        for name in ONLY_SIMULATED:
            if servo_host.present and wish.get(name) is not None:
                pytest.skip(f"it asks for a drive with {name}, and {DRIVES_OPTION} is {PRESENT}")
        return stack.enter_context(drive_rig(servo_bus, servo_host, DriveWish(**wish)))

    with ExitStack() as stack:
        yield make


def _recordings(request: pytest.FixtureRequest, temporary: pytest.TempPathFactory) -> Path:
    """Return the folder for the runs of a test: one that no other test uses."""
    record = request.config.getoption(RECORD_OPTION)
    if record is None:
        return temporary.mktemp("bench")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", request.node.nodeid).strip("_")
    folder = Path(request.config.invocation_params.dir, record, name)
    again = 1
    while folder.exists():
        again += 1
        folder = folder.with_name(f"{name}-{again}")
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def servo_bench(
    servo_bus: str,
    servo_host: "DriveHost",
    tmp_path_factory: pytest.TempPathFactory,
    request: pytest.FixtureRequest,
) -> Iterator["BenchRunner"]:
    """Run a bench on the bus of the test: ``run = servo_bench("bench.toml", {"bench.seed": 7})``.

    Where the runs are recorded is a property of the test in a JUnit report.
    """
    from servobench.hil.testing.bench_runs import BenchRunner

    recordings = _recordings(request, tmp_path_factory)
    yield BenchRunner(servo_bus, servo_host, recordings, Path(request.path).parent)
    for run in sorted(recordings.glob("run-*")):
        request.node.user_properties.append(("recording", str(run)))


@pytest.fixture
def servo_campaign(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> "CampaignRunner":
    """Run a sweep in simulated time: ``servo_campaign("sweep.toml").assert_pass_rate(at_least=0.99)``."""
    try:
        from servobench.hil.testing.campaign_runs import CampaignRunner
    except ModuleNotFoundError as error:
        from servobench.hil.machine.extras import missing_extra

        raise missing_extra(error, "the fixture servo_campaign") or error from None

    return CampaignRunner(tmp_path_factory.mktemp("campaign"), Path(request.path).parent)
