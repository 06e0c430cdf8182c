"""The command ``hil measure`` behind its options."""

from collections.abc import Sequence

from drivers.errors import BadInput
from drivers.timebase import utc_stamp
from drivers.wire.adapters import parse_bus_spec
from hil.configuration.motor_file import LING2012
from hil.execution.bench import RUNS_FOLDER
from hil.execution.simulated_drives import drive_parameters
from hil.execution.world import WorldPlan, open_world
from hil.machine.progress import Progress
from hil.machine.realtime import timing_conditions
from hil.machine.stopping import stop_signals
from hil.measuring.figures import Measured
from hil.measuring.measure import Say, measure
from hil.measuring.request import MeasureRequest
from virtual_bus.drive.servo import SimulatedServo


def run_measurement(request: MeasureRequest, say: Say, progress: Progress) -> Measured:
    """Measure on the bus of the request; the drives of a simulated one are made here.

    Raises BadInput for a request that does not fit the bus, otherwise as
    :func:`hil.measuring.measure.measure`.
    """
    spec = parse_bus_spec(request.bus, "--bus")
    if request.motor is not None and not spec.simulated:
        raise BadInput("--motor", "", request.bus, "the bus 'simulated': other drives have their own motors")
    devices: Sequence[SimulatedServo] = ()
    if spec.simulated:
        motor, drive = request.motor or LING2012.parameters, drive_parameters(())
        devices = [SimulatedServo(node, motor, drive, request.seed) for node in request.nodes]
    plan = WorldPlan(spec, request.bitrate_bit_s, False, request.faults, request.seed)
    folder = RUNS_FOLDER / f"measure-{utc_stamp()}"
    with (
        stop_signals() as stop,
        open_world(plan, devices) as world,
        timing_conditions(world.real_time) as refused,
    ):
        for wish in refused:
            say(f"not granted by the kernel: {wish}")
        return measure(request, world, stop, folder, say, progress)
