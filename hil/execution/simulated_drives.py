"""Makes simulated drives for a bench or a command line.

Two nodes with one id answer as one. On a bus with a real drive a second one would be its twin, and follow its
torques: so a shared bus is scanned first.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from servobench.design.motor import PmsmParameters
from servobench.design.statespace import StateSpace
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.canopen.cob_ids import NODE_BITS, SENT_BY_NODES
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, UNCONFIGURED
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.errors import AnswersTwice, BadInput, NoAnswer, PeerFault, printable
from servobench.drivers.timebase import NS_PER_S, Clock, Duration, Instant
from servobench.drivers.wire.adapters import BusSpec, shared_bus
from servobench.drivers.wire.link import BusLink
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.controller_files import CurrentController, read_current_controller
from servobench.hil.configuration.drive_model import DriveModel
from servobench.hil.configuration.references import SignalFile
from servobench.hil.execution.device_files import DeviceFiles
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.load.simulated_load import SimulatedLoadMachine, load_table
from servobench.hil.machine.realtime import realtime_process
from servobench.hil.machine.stopping import stop_signals
from servobench.virtual_bus.device.background import Stream, background_nodes
from servobench.virtual_bus.device.lss_slave import NODE_ID_KEY
from servobench.virtual_bus.device.parameter_storage import FileStore
from servobench.virtual_bus.drive.load_object import LoadTable
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.frame import Device
from servobench.virtual_bus.hosting.devices import serve
from servobench.virtual_bus.hosting.injection import Faults

LISTEN_FOR: Final = Duration(NS_PER_S)
"""In this time a node with a heartbeat, or in operation, is nearly always heard; the others are asked."""
ANSWER_LIMIT_S: Final = 0.1
"""Time for one answer: a node that boots, or a full bus, takes less."""
ATTEMPTS: Final = 2
"""Attempts, since a frame may be lost."""


def simulated_drives(config: BenchConfig) -> list[SimulatedServo]:
    """Make the drives of a bench, for its own simulated bus. Raises BadInput for an impossible one."""
    drives = []
    for axis in config.axes:
        try:
            drives.append(_simulated_drive(config, axis))
        except ValueError as error:
            key = f"drive.{axis}.simulation.lacks"
            expected = "objects that the simulated drive has and could do without"
            raise BadInput(config.source, key, str(error), expected, "see hil docs simulated-drive") from None
    return drives


def _simulated_drive(config: BenchConfig, axis: str) -> SimulatedServo:
    drive, seed = config.drive[axis], config.bench.seed
    simulation, rate_hz = drive.simulation, drive.simulation.inner_rate_hz
    machine = (simulation.motor or drive.motor).parameters
    parameters = DriveParameters(
        **simulation.model_dump(exclude={"eds", "motor", "believes", "like", "rehearse"}),
        **({} if simulation.like is None else simulation.like.parameters),
        controller_q=_at_rate(drive.current_control.controller, rate_hz),
        controller_d=_at_rate(drive.current_control.controller_d, rate_hz),
        load=_load_of(config, axis),
        machine=None if simulation.believes is None else machine,
    )
    if simulation.rehearse is not None:
        return unknown_drive(simulation.rehearse, drive.node, parameters)[0]
    motor = machine if simulation.believes is None else simulation.believes.parameters
    files = DeviceFiles(None if simulation.eds is None else Path(simulation.eds))
    return servo_of(files, drive.node, motor, parameters, seed)


def servo_of(
    files: DeviceFiles,
    node: int,
    motor: PmsmParameters,
    parameters: DriveParameters,
    seed: int = 0,
    announce: Callable[[str], None] = lambda _text: None,
    bitrate_bit_s: int | None = None,
) -> SimulatedServo:
    """Make the simulated drive of a data sheet, or servobench's own."""
    vendor = files.vendor(announce, [node], bitrate_bit_s, motor)
    return SimulatedServo(node, motor, files.drive(parameters), seed, vendor=vendor)


def _load_of(config: BenchConfig, axis: str) -> LoadTable | None:
    """Return the shaft's load over time; None if an instrument makes it, or there is none."""
    if axis == config.load_machine_axis:
        return None
    files = (each for each in config.load.get(axis, ()) if isinstance(each, SignalFile))
    return next((load_table(each.signal) for each in files), None)


def _at_rate(controller: CurrentController | None, rate_hz: int) -> StateSpace | None:
    """Return the controller for the firmware. Raises BadInput if it cannot run at its inner rate."""
    if controller is None:
        return None
    try:
        return controller.at_rate(rate_hz)
    except ValueError as error:
        raise BadInput(
            "current_control", controller.axis, str(error), f"a controller for an inner rate of {rate_hz} Hz"
        ) from None


def drive_parameters(
    current_control: Sequence[Path], like: DriveModel | None = None, gain_objects: bool = False
) -> DriveParameters:
    """Return the parameters of the drives of ``hil simulate``, with the current controllers in these files.
    Raises BadInput."""
    controllers: dict[str, StateSpace | None] = {"q": None, "d": None}
    modelled = {} if like is None else like.parameters | like.rates
    rate_hz = DriveParameters(**modelled).inner_rate_hz
    for path in current_control:
        controller = read_current_controller(path, NamedBy("--current-control", "", str(path)))
        if controllers[controller.axis] is not None:
            raise BadInput(
                "--current-control", "", str(path), f"one controller for the {controller.axis} axis at most"
            )
        controllers[controller.axis] = _at_rate(controller, rate_hz)
    return DriveParameters(
        controller_q=controllers["q"],
        controller_d=controllers["d"],
        gain_objects=gain_objects,
        **modelled,
    )


def simulate(
    *,
    bus_spec: str,
    nodes: Sequence[int],
    motor: PmsmParameters,
    faults: Faults | None,
    bitrate_bit_s: int,
    seed: int,
    announce: Callable[[str], None],
    files: DeviceFiles,
    background: Sequence[Stream] = (),
    current_control: Sequence[Path] = (),
    like: DriveModel | None = None,
    gain_objects: bool = False,
    loads: Mapping[int, LoadTable] = MappingProxyType({}),
    load_machine: SimulatedLoadMachine | None = None,
    serials: Sequence[int] = (),
    force: bool = False,
) -> None:
    """Simulate drives, and other nodes' traffic, on a real-time bus until a stop signal comes.

    ``announce`` is called once the drives are on the bus. ``loads``: by node, loads that a bench can apply to
    its shaft. ``serials``: as in :func:`serial_of_each`. ``force``: even if their node-IDs are taken. Raises
    BadInput for a bus in simulated time, which no other process could join, and for a node-ID that somebody
    has, and BusDown if the bus cannot be opened or goes away.
    """
    spec = shared_bus(bus_spec, "use hub:NAME, or run the bench itself with --bus simulated")
    store = files.memory(nodes)
    makers = files.makers(files.vendor(announce, nodes, bitrate_bit_s, motor), serial_of_each(nodes, serials))
    drive = files.drive(drive_parameters(current_control, like, gain_objects))
    devices = [
        SimulatedServo(node, motor, replace(drive, load=loads.get(node)), seed, store=store, vendor=vendor)
        for node, vendor in zip(nodes, makers, strict=True)
    ]
    files.write_data_sheet(devices[0].dictionary, announce)
    plan = WorldPlan(spec, bitrate_bit_s, faults=faults, seed=seed, side="drive")
    ids = ids_on_the_bus(nodes, store)
    title = _announcement(spec, nodes, motor)
    others = background_nodes(background, seed)
    host_drives(plan, devices, ids, title, announce, others=others, load_machine=load_machine, force=force)


def host_drives(
    plan: WorldPlan,
    drives: Sequence[SimulatedServo],
    ids: Sequence[int],
    title: str,
    announce: Callable[[str], None],
    *,
    others: Iterable[Device] = (),
    load_machine: SimulatedLoadMachine | None = None,
    force: bool = False,
) -> None:
    """Host ``drives``, and fault-free ``others``, on the bus of ``plan`` until a stop signal.

    ``ids``: node-IDs that must be free, unless ``force``. ``announce`` is called with ``title`` once they are
    on it. ``load_machine``: on the shaft of the first. Raises BadInput, BusDown.
    """
    with stop_signals() as stop, open_world(plan, ()) as world:
        refuse_taken(world.link, world.clock, ids, announce, force)
        hosted: list[Device] = [world.faults.wrap(drive) for drive in drives]
        world.faults.start(world.clock.now())
        hosted += others
        with ExitStack() as leaving, realtime_process() as refused:
            for request in refused:
                announce(f"not granted by the kernel: {request}")
            if load_machine is not None:
                hosted.append(leaving.enter_context(load_machine.coupled_to(drives[0], plan.seed, announce)))
            announce(title)
            serve(hosted, world.link.bus, world.clock, stop)


def serial_of_each(nodes: Sequence[int], serials: Sequence[int]) -> list[int | None]:
    """Return the serial number of each node: the requested ones; else no two nodes without id have the same.

    None: the data sheet's, or that of the simulated drive, its node-ID.
    """
    if serials:
        return list(serials)
    if nodes.count(UNCONFIGURED) <= 1:
        return [None] * len(nodes)
    counted = count(UNCONFIGURED)
    return [next(counted) if node == UNCONFIGURED else None for node in nodes]


def ids_on_the_bus(nodes: Sequence[int], store: FileStore | None) -> list[int]:
    """Return the ids that the devices will have: one stored by LSS overrides the original."""
    stored = None if store is None else store.load().get(NODE_ID_KEY)
    return [stored[0]] if stored else list(nodes)


def _announcement(spec: BusSpec, nodes: Sequence[int], motor: PmsmParameters) -> str:
    listed = ", ".join("unconfigured" if node == UNCONFIGURED else str(node) for node in nodes)
    return f"simulated drive on {spec}: node {listed}, motor {motor.name}; Ctrl-C ends it"


def refuse_taken(
    link: BusLink, clock: Clock, nodes: Sequence[int], say: Callable[[str], None], force: bool
) -> None:
    """Listen and ask, before the devices of ``nodes`` are put on the bus; invalid ids are skipped.

    Nothing is asked on a hub without other clients. Raises BadInput naming the owner of such an id; with
    ``force`` it is only reported.
    """
    ids = [node for node in nodes if 1 <= node <= NODE_ID_MAX]
    if not ids or _alone(link.bus):
        return
    heard = _heard(link, clock, ids)
    network = CanopenNetwork(link, clock)
    taken = [who for node in ids if (who := _who_is(network, node, heard.get(node, ""))) is not None]
    if not taken:
        return
    there = "; ".join(taken)
    if not force:
        remedy = "take another node-ID, or end that one; --force joins nevertheless"
        raise BadInput("--node", "", there, f"node-IDs that nobody has on {link.name}", remedy)
    say(f"forced: joining {link.name} although {there}")


def _alone(bus: Any) -> bool:
    """Return True on a hub without other clients. Later clients check for us."""
    status = getattr(getattr(bus, "inner", bus), "status", None)
    return status is not None and bool(getattr(status(), "alone", False))


def _heard(link: BusLink, clock: Clock, nodes: Collection[int]) -> dict[int, str]:
    """Return what was last heard from each of the nodes."""
    heard: dict[int, str] = {}
    until = Instant(clock.now() + LISTEN_FOR)
    while (received := link.recv(until)) is not None:
        kind, node = SENT_BY_NODES.get(received[0] & ~NODE_BITS), received[0] & NODE_BITS
        if kind is not None and node in nodes:
            heard[node] = f"{'an' if kind[0] in 'ES' else 'a'} {kind}"
        if clock.now() >= until:
            break
    return heard


def _who_is(network: CanopenNetwork, node: int, heard: str) -> str | None:
    """Describe the node; None if nobody has that id."""
    answers = True
    try:
        network.upload(node, Cia301.DEVICE_TYPE, 0, ANSWER_LIMIT_S, ATTEMPTS)
    except NoAnswer:
        answers = False
    except AnswersTwice:  # nobody has asked for what came
        answers, heard = False, heard or "an SDO answer"
    except PeerFault:
        pass  # an abort is an answer too
    if not answers:
        return f"node {node} is there: {heard} was heard" if heard else None
    name = b""
    with suppress(PeerFault):
        name = network.upload(node, Cia301.DEVICE_NAME, 0, ANSWER_LIMIT_S, ATTEMPTS)
    text = printable(name.split(b"\0", 1)[0].decode("latin-1").strip())
    return f"node {node} is there: {text or 'an unnamed device'} answers"
