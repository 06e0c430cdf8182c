"""pytest plugin of servobench: drives and benches as fixtures. docs/tutorial-pytest.md leads through it.

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
"""Wishes that only a drive of the plugin's own making can meet."""


class MakeDrive(Protocol):
    """The fixture ``servo_drive``."""

    def __call__(self, **wish: Any) -> "DriveRig":
        """A drive; ``wish``: fields of :class:`servobench.hil.testing.hosted.DriveWish`."""
        ...


class StartDrive(Protocol):
    """The fixture ``servo_process``."""

    def __call__(self, *nodes: int, **wish: Any) -> "DriveProcess":
        """Drives in one process; ``wish``: fields of :class:`servobench.hil.testing.hosted.DriveWish`."""
        ...


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--servo-bus SPEC``, ``--servo-drives``, ``--servo-record DIR``."""
    group = parser.getgroup("servobench", "simulated servo drives")
    group.addoption(
        BUS_OPTION,
        metavar="SPEC",
        default=None,
        help="bus of the tests that choose none: simulated (default), hub, vcan, socketcan:NAME",
    )
    group.addoption(
        DRIVES_OPTION,
        choices=(SIMULATED, PRESENT),
        default=SIMULATED,
        help="simulated: put drives on the bus (default); present: use those that are there",
    )
    group.addoption(
        RECORD_OPTION,
        metavar="DIR",
        default=None,
        help="keep the recording of each run of servo_bench, in a folder of DIR named for the test",
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


def _bus_spec(name: str) -> str:
    """A bus SPEC; ``hub`` alone stands for a hub that no other test has, ``vcan`` for socketcan:vcan0."""
    if name == "hub":
        return f"hub:test-{os.getpid()}-{next(_hub_numbers)}"
    return "socketcan:vcan0" if name == "vcan" else name


def _down(spec: str) -> str | None:
    """Of a SocketCAN interface that is not up, that it is not, and the command that mends it."""
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
    """SPEC of the bus that the test is on; a SocketCAN interface that is not up skips the test.

    It fails the test if the bus was asked for on the command line.
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
    """The drive processes of the test; they end with it."""
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
    """Where the runs of a test are recorded: a folder that no other test has."""
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
    from servobench.hil.testing.campaign_runs import CampaignRunner

    return CampaignRunner(tmp_path_factory.mktemp("campaign"), Path(request.path).parent)
