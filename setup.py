"""Compiles the hot modules with mypyc: ``SERVOBENCH_COMPILE=1 python setup.py build_ext --inplace``.

Everything else about the package stands in pyproject.toml. Without the variable nothing is compiled,
and the same modules run interpreted, with the same results.
"""

import json
import os
import shutil
import sys
import sysconfig
from contextlib import redirect_stdout
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).parent
ROOMS = ("design", "drivers", "virtual_bus", "hil")
MANIFEST = ROOT / "drivers" / "compiled.json"


def _below(folder: str, names: str) -> list[str]:
    return [f"{folder}/{name}.py" for name in names.split()]


HOT_MODULES = [
    *_below("drivers", "exchange record timebase"),
    *_below("drivers/canopen", "frame_pump nmt"),
    *_below("drivers/cia402", "command_watch drive_watch readings servo setpoint supervision"),
    *_below("drivers/wire", "frame_port link message_port"),
    *_below("hil/control", "compensation controllers load_filter motion predictor"),
    *_below("hil/loop", "attribution axis axis_roles clock_map clock_question command_meter context"),
    *_below(
        "hil/loop", "delay loop order_attribution pace safety samples scenario stamp_attribution syncs ticker"
    ),
    *_below("hil/recording", "ring row_writer"),
    *_below("hil/rows", "records side_rows"),
    *_below("virtual_bus", "event_heap frame pacing timeline"),
    *_below("virtual_bus/bus", "arbitration bit_length bus_load controller error_frame error_handling"),
    *_below("virtual_bus/bus", "error_state filters frame_image host_port hub_broker hub_port hub_protocol"),
    *_below("virtual_bus/bus", "inbox judge listener port segment trial"),
    *_below("virtual_bus/device", "application canopen_device device_clock heartbeat object_dictionary"),
    *_below("virtual_bus/device", "pdo_codec pdo_engine pdo_parameters rpdo station sync_consumer tpdo"),
    *_below("virtual_bus/drive", "actual_values axis cyclic_modes error_codes firmware halt homing"),
    *_below("virtual_bus/drive", "homing_methods machine operation_mode operation_modes power_state"),
    *_below("virtual_bus/drive", "profile_position profile_torque profile_velocity servo servo_parameters"),
    *_below("virtual_bus/drive", "slow_values trajectory user_units"),
    *_below("virtual_bus/faults", "fates fault_injector fault_log fault_streams special_faults strikes"),
    *_below("virtual_bus/hosting", "devices"),
]
"""What runs in every cycle of the loop or of a simulated drive."""


def compiler_lack() -> str | None:
    """Why C cannot be compiled here, or None."""
    compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc").split()[0]
    if shutil.which(compiler) is None:
        return f"no C compiler {compiler!r} is here"
    header = Path(sysconfig.get_path("include"), "Python.h")
    return None if header.exists() else f"{header} is not here (Debian: apt-get install python3-dev)"


def remove_compiled() -> None:
    """Take away what an earlier build has left; the manifest first, so that half a build is known as one."""
    MANIFEST.unlink(missing_ok=True)
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.so"):
            path.unlink()


def extensions() -> list[Extension]:
    """The hot modules as one library and a stub for each."""
    from mypyc.build import mypycify

    with redirect_stdout(sys.stderr):  # its remarks belong to the log, like the compiler's
        made = mypycify(list(HOT_MODULES), opt_level="3", debug_level="0", group_name="drivers.compiled")
    for extension in made:
        # A fused multiply-add, where the processor has it, would change the last bit of a result.
        extension.extra_compile_args.append("-ffp-contract=off")
        if sys.platform == "linux":
            # Calls among the modules go through no table that another library could change: 4 % of the time.
            extension.extra_compile_args += ["-fvisibility=hidden", "-fno-semantic-interposition", "-fno-plt"]
    return made


class BuildWithManifest(build_ext):
    """Notes from which sources the compiled modules were made."""

    def run(self) -> None:
        from hil.machine.compiled import digest_of

        sources = {name: digest_of(ROOT / name) for name in HOT_MODULES}
        super().run()
        if self.inplace:
            MANIFEST.write_text(json.dumps(sources, indent=1))


def main() -> None:
    """Compile if that was asked for, is possible and is needed; else hand on to setuptools."""
    if not os.environ.get("SERVOBENCH_COMPILE"):
        setup()
        return
    os.chdir(ROOT)
    lack = compiler_lack()
    if lack is not None:
        remove_compiled()
        print(f"Not compiled: {lack}. Everything works, interpreted and slower.")
        return
    from hil.machine.compiled import stale_modules

    if MANIFEST.exists() and not stale_modules(ROOT, HOT_MODULES):
        return
    remove_compiled()
    print(f"Compiling {len(HOT_MODULES)} hot modules with mypyc: a minute or two", flush=True)
    setup(ext_modules=extensions(), cmdclass={"build_ext": BuildWithManifest})


if __name__ == "__main__":
    if sys.argv[1:] == ["remove"]:
        remove_compiled()
    else:
        main()
