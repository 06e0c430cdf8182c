"""Builds the native core, and compiles the hot modules with mypyc, in groups: in place, or into a wheel.

Everything else about the package stands in pyproject.toml. The core is always built: by the machine's C
compiler, or by one that comes as a package. What mypyc has not compiled runs interpreted, with the same
results. A wheel is compiled where a C compiler is there; ``SERVOBENCH_COMPILE=1`` makes the lack of one an
error, ``SERVOBENCH_PURE=1`` leaves the wheel uncompiled.
"""

import json
import os
import shutil
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout
from hashlib import blake2b
from pathlib import Path
from typing import Any

from setuptools import Distribution, Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py
from setuptools.errors import BaseError, CCompilerError

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))  # pip imports this file from elsewhere

from servobench.design.core import build as core  # noqa: E402
from servobench.drivers.compiled import MANIFEST, PACKAGE, PURE, ROOMS, SUFFIX, digest_of, look  # noqa: E402

REQUIRED = bool(os.environ.get("SERVOBENCH_COMPILE"))
ROOMS_BELOW = ROOT / PACKAGE
"""The rooms: links to the folders beside this file, or in an sdist the folders themselves."""
MYPY = ["--cache-dir=/dev/null", "--follow-imports=silent"]
"""No cache: mypyc 2.4.1 fails at attributes of classes that it takes from one. Silent: a module that is not
compiled may use a package that the build under pip has not."""


def _below(folder: str, names: str) -> list[str]:
    return [f"{folder}/{name}.py" for name in names.split()]


GROUPS = {
    "wire": [
        *_below("drivers", "exchange record timebase"),
        *_below("drivers/canopen", "frame_pump nmt"),
        *_below("drivers/cia402", "drive_watch follow_watch readings servo setpoint supervision"),
        *_below("drivers/wire", "frame_port message_port"),
    ],
    "loop": [
        *_below("hil/control", "compensation controllers load_filter predictor"),
        *_below(
            "hil/loop",
            "answered_syncs attribution axis beats clock_map clock_question command_meter protocol",
        ),
        *_below("hil/loop", "cycle_record delay drive_stamps followed_command kept_order late_drive"),
        *_below("hil/loop", "loop order_attribution order_evidence order_memory order_question pace"),
        *_below("hil/loop", "period_doubt readback_tie residuals safety samples scenario"),
        *_below("hil/loop", "stamp_attribution suspects syncs usual_delays way_back"),
        *_below("hil/recording", "row_writer"),
        *_below("hil/rows", "side_rows"),
    ],
    "bus": [
        *_below("virtual_bus", "frame"),
        *_below("virtual_bus/bus", "controller error_frame error_handling frame_image host_port hub_broker"),
        *_below("virtual_bus/bus", "hub_client hub_protocol listener"),
    ],
    "device": [
        *_below("virtual_bus/device", "canopen_device heartbeat object_dictionary"),
        *_below("virtual_bus/device", "pdo_engine pdo_parameters station sync_consumer"),
        *_below("virtual_bus/drive", "actual_values axis cyclic_modes failures firmware homing"),
        *_below(
            "virtual_bus/drive",
            "homing_methods machine operation_mode operation_modes power_state",
        ),
        *_below("virtual_bus/drive", "profile_modes servo set_point_path vl_mode"),
        *_below("virtual_bus/drive", "servo_parameters trajectory user_units"),
        *_below("virtual_bus/hosting", "devices"),
    ],
}
"""What runs in every cycle of the loop or of a simulated drive. A group is one library, compiled anew as a
whole; those it imports from come before it in the floors of docs/architecture.md (decision 0018)."""


def compiler_lack() -> str | None:
    """Why C cannot be compiled here, or None."""
    compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc").split()[0]
    if shutil.which(compiler) is None:
        return f"no C compiler {compiler!r} was there"
    header = Path(sysconfig.get_path("include"), "Python.h")
    return None if header.exists() else f"{header} was not there (Debian: apt-get install python3-dev)"


def remove_compiled(keep: Iterable[str] = ()) -> None:
    """Take away what an earlier build has left beside the sources, but for the files ``keep``.

    The manifest goes first: without it nothing of what is left is used.
    """
    (ROOMS_BELOW / MANIFEST).unlink(missing_ok=True)
    kept = frozenset(keep)
    for room in ROOMS:
        for path in (ROOMS_BELOW / room).rglob("*.so"):
            if path.name != core.LIBRARY and path.relative_to(ROOT).as_posix() not in kept:
                path.unlink()


def library_of(group: str) -> str:
    """The name that the library of a group is imported by."""
    room, _, _ = GROUPS[group][0].partition("/")
    return f"{PACKAGE}.{room}.compiled_{group}__mypyc"


def extensions() -> list[Extension]:
    """For each group a library, and for each module a stub that takes it from there."""
    from mypyc.build import mypycify

    paths = [f"{PACKAGE}/{path}" for group in GROUPS.values() for path in group]
    separate = [
        ([f"{PACKAGE}/{path}" for path in group], library_of(name).removesuffix("__mypyc"))
        for name, group in GROUPS.items()
    ]
    with redirect_stdout(sys.stderr):  # its remarks belong to the log, like the compiler's
        made = mypycify([*MYPY, *paths], opt_level="3", debug_level="0", separate=separate)
    # A fused multiply-add, where the processor has it, would change the last bit of a result.
    flags = ["-ffp-contract=off"]
    if sys.platform == "linux":
        # Calls within a group go through no table that another library could change: 4 % of the time.
        flags += ["-fvisibility=hidden", "-fno-semantic-interposition", "-fno-plt"]
    for extension in made:  # some of them share a list
        extension.extra_compile_args = [*extension.extra_compile_args, *flags]
    return list(made)


def digest_of_extension(extension: Extension) -> str:
    """What tells one build of an extension from another: its C, every header of ours in it, the flags."""
    from mypy.version import __version__ as mypy_version

    flags = [os.environ.get(name, "") for name in ("CC", "CFLAGS", "LDFLAGS")]
    digest = blake2b(
        "\0".join([mypy_version, *flags, *extension.extra_compile_args]).encode(), digest_size=16
    )
    for path in sorted({*extension.sources, *extension.depends}):
        digest.update(path.encode() + Path(path).read_bytes())
    return digest.hexdigest()


def manifest_of(made: Iterable[Extension]) -> dict[str, Any]:
    """From which sources each group is compiled, and against which other groups.

    Against another: that group's class layouts and signatures, in its headers, are in this one's code.
    """
    depends = {extension.name: {Path(path).name for path in extension.depends} for extension in made}
    return {
        "suffix": SUFFIX,
        "groups": {
            group: {
                "sources": {path: digest_of(ROOMS_BELOW / path) for path in paths},
                "against": [
                    other
                    for other in GROUPS
                    if other != group and f"__native_compiled_{other}.h" in depends[library_of(group)]
                ],
            }
            for group, paths in GROUPS.items()
        },
    }


class BuildGroups(build_ext):
    """Compiles those extensions whose C has changed, and notes from which sources all were made."""

    def run(self) -> None:
        manifest = manifest_of(self.extensions)
        self.force = True  # what has not changed is found by its digest, not by the ages of files
        self.parallel = len(os.sched_getaffinity(0))
        target = ROOMS_BELOW / MANIFEST if self.inplace else Path(self.build_lib, PACKAGE, MANIFEST)
        if self.inplace:
            manifest["built"] = self._leave_out_what_is_built()
        try:
            super().run()
        except (BaseError, CCompilerError) as error:
            if self.inplace or REQUIRED:
                raise
            for path in Path(self.build_lib).rglob("*.so"):
                path.unlink()
            manifest = {"lack": f"compiling failed: {error}"}
        target.write_text(json.dumps(manifest, indent=1))

    def _leave_out_what_is_built(self) -> dict[str, str]:
        """Extension -> digest, of all; those that lie beside their sources already are not compiled."""
        digests = {extension.name: digest_of_extension(extension) for extension in self.extensions}
        manifest = ROOMS_BELOW / MANIFEST
        before = json.loads(manifest.read_text()).get("built", {}) if manifest.exists() else {}
        files = {name: name.replace(".", "/") + SUFFIX for name in digests}
        kept = [
            name for name in digests if digests[name] == before.get(name) and (ROOT / files[name]).exists()
        ]
        remove_compiled(keep=[files[name] for name in kept])
        self.extensions = [each for each in self.extensions if each.name not in kept]
        anew = [group for group in GROUPS if library_of(group) not in kept]
        if anew:
            print(f"Compiling {', '.join(anew)} with mypyc: up to some minutes", flush=True)
        return digests


class PackBuilt(build_ext):
    """Packs what is compiled beside the sources as it is."""

    def run(self) -> None:
        built = [path for room in ROOMS for path in (ROOMS_BELOW / room).rglob(f"*{SUFFIX}")]
        for path in (*built, ROOMS_BELOW / MANIFEST):
            target = Path(self.build_lib, path.relative_to(ROOT))
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)


class WithShipped(build_py):
    """``hil init`` writes examples, and ``hil docs`` prints pages, from a wheel as from a checkout."""

    def run(self) -> None:
        super().run()
        hil = Path(self.build_lib, PACKAGE, "hil")
        unwanted = shutil.ignore_patterns("__pycache__", ".*")
        shutil.copytree(ROOT / "examples", hil / "examples", ignore=unwanted, dirs_exist_ok=True)
        for page in (ROOT / "docs").rglob("*.md"):
            target = hil / page.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(page, target)


class WithCore(Distribution):
    """What is packed is for one machine and, where mypyc compiled nothing, for every Python from 3.11 on."""

    def has_ext_modules(self) -> bool:
        return True


class NoteLack(WithShipped):
    """A wheel that is not compiled tells why."""

    lack = ""

    def run(self) -> None:
        super().run()
        Path(self.build_lib, PACKAGE, MANIFEST).write_text(json.dumps({"lack": self.lack}))


def is_compiled() -> bool:
    """Whether each hot module is compiled beside its source, from that source."""
    build = look(ROOMS_BELOW)
    return not build.why and build.sources == {path for group in GROUPS.values() for path in group}


def compile_in_place() -> None:
    """Bring what is compiled beside the sources up to date, if that is possible."""
    lack = compiler_lack()
    if lack is not None:
        remove_compiled()
        print(f"Not compiled: {lack}. Everything works, interpreted and slower.")
    elif not is_compiled():
        setup(ext_modules=extensions(), cmdclass={"build_ext": BuildGroups})


def build_wheel() -> None:
    """A wheel with compiled modules, or one without that tells why."""
    for left in (ROOT / "build").glob("lib*"):  # modules that are no more would be packed too
        shutil.rmtree(left)
    if is_compiled():
        setup(cmdclass={"build_ext": PackBuilt, "build_py": WithShipped}, distclass=WithCore)
        return
    lack = f"{PURE} was set" if os.environ.get(PURE) else compiler_lack()
    if lack is None:
        setup(ext_modules=extensions(), cmdclass={"build_ext": BuildGroups, "build_py": WithShipped})
        return
    if REQUIRED:
        sys.exit(f"SERVOBENCH_COMPILE is set, but {lack}")
    print(f"Not compiled: {lack}", file=sys.stderr)
    NoteLack.lack = lack
    every = {"bdist_wheel": {"py_limited_api": "cp311"}}
    setup(cmdclass={"build_py": NoteLack}, distclass=WithCore, options=every)


def main(arguments: Sequence[str]) -> None:
    """What the command line asks for; anything but a build is left to setuptools."""
    os.chdir(ROOT)
    if arguments == ["remove"]:
        remove_compiled()
    elif "build_ext" in arguments:
        compile_in_place()
    elif "bdist_wheel" in arguments:
        core.build_all()
        build_wheel()
    elif "editable_wheel" in arguments:
        core.build_all()
        setup()
    elif "egg_info" in arguments:  # as a frontend asks for what a build requires
        setup(setup_requires=core.required())
    else:
        setup()


if __name__ == "__main__":
    main(sys.argv[1:])
