"""User controllers and compensators: found, made, and kept from doing harm.

Whatever such a class raises, ``sys.exit()`` included, an answer that is no number, and a call that does not
come back end the run like any failure: the drives are brought to rest, and the message names the line.
"""

import importlib
import importlib.util
import inspect
import math
import re
import signal
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any, Final, NoReturn, TypeVar

from servobench.drivers.errors import MISSING, BadInput, BenchError
from servobench.drivers.exchange import Command
from servobench.drivers.key_advice import unknown_key
from servobench.drivers.record import values_of
from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock
from servobench.hil.control.setup import Setup
from servobench.hil.loop.protocol import CHANNELS_MAX, Compensator, Context, Controller, SetPoint
from servobench.hil.loop.samples import Sample, StateEstimate
from servobench.hil.machine.held_process import (
    FAILURES,
    OWN_FILES,
    enter_call,
    held_process,
    in_words,
    leave_call,
    remember_modules,
    told,
)

OBJECT_PATTERN: Final = r"^([A-Za-z_][\w.]*|.+\.py):[A-Za-z_]\w*$"
"""MODULE:NAME or FILE.py:NAME."""
DIGEST_BYTES: Final = 16
"""128 bits: of 2^64 files two are alike by chance."""
_FILES: Final = "controller file "
"""Before the names of modules from files: no import statement finds them."""
_SIGNAL: Final = signal.SIGRTMIN + 7
"""One that nothing else of the bench, of pytest or of a solver is known to use."""
_LOOK_S: Final = 0.05
"""Interval of the check for long calls: far below any patience, and no load."""
_CHANNEL: Final = re.compile(r"[a-z][a-z0-9_]*")


class OwnCodeFailed(BenchError):
    """A user's controller or compensator raised, returned no number, or did not return."""


class _TookTooLong(Exception):
    """Raised in the midst of a call that does not come back."""


def source_of(name: str) -> tuple[Path, str]:
    """The file that holds the object, and its digest (BLAKE2b, 128 bit, hex); runs nothing of it but, for a
    module in a package, that package. Raises ValueError: there is none."""
    place, _, _ = name.rpartition(":")
    if place.endswith(".py"):
        path = Path(place)
    else:
        try:
            spec = importlib.util.find_spec(place)
        except ImportError:
            spec = None
        if spec is None or spec.origin is None:
            raise ValueError(f"there is no module {place}")
        path = Path(spec.origin)
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    return path, blake2b(path.read_bytes(), digest_size=DIGEST_BYTES).hexdigest()


Role = TypeVar("Role", Compensator, Controller)
_REQUIRED: Final[Mapping[type, Sequence[str]]] = {Controller: ["output"], Compensator: ["estimate"]}
"""Methods that the base class leaves open."""


def _made(role: type[Role], name: str, parameters: Mapping[str, Any], setup: Setup) -> Role:
    key = f"drive.{setup.axis}.{role.__name__.lower()}"
    maker: Any = _class_of(role, name, setup.source, f"{key}.object")
    _check_parameters(maker, name, parameters, setup, f"{key}.parameters")
    try:
        with held_process():
            made: Role = maker(setup, **parameters)
    except FAILURES as error:
        takes, reason = f"values that {name} can be made with", _placed(error, name.rpartition(":")[0])
        raise BadInput(setup.source, f"{key}.parameters", dict(parameters), takes, reason) from error
    return made


def _check_parameters(maker: Any, name: str, parameters: Mapping[str, Any], setup: Setup, key: str) -> None:
    """Raise BadInput for a parameter that the class does not take, or has no default for."""
    try:
        signature = inspect.signature(maker)
    except (TypeError, ValueError):
        return  # it tells none: making it will say
    takes = list(signature.parameters.values())[1:]
    if any(each.kind is each.VAR_KEYWORD for each in takes):
        return
    by_name = {
        each.name: each for each in takes if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)
    }
    for given in parameters:
        if given not in by_name:
            raise unknown_key(setup.source, f"{key}.{given}", parameters[given], list(by_name))
    for each in by_name.values():
        if each.default is each.empty and each.name not in parameters:
            raise BadInput(
                setup.source, f"{key}.{each.name}", MISSING, f"a value: {name} has no default for it"
            )


def _class_of(role: type[Role], name: str, source: str, key: str) -> type[Role]:
    """Return the class that ``name`` names. Raises BadInput: there is none, or it is none of ``role``."""
    place, _, last = name.rpartition(":")
    try:
        module = _loaded(name)
    except FAILURES as error:
        kind = "a file" if place.endswith(".py") else "a module"
        raise BadInput(source, key, name, f"{kind} that Python can load", _placed(error, place)) from error
    named = getattr(module, last, None)
    expected = f"a class derived from servobench.{role.__name__}, as MODULE:NAME or FILE.py:NAME"
    if not (isinstance(named, type) and issubclass(named, role)):
        there = [each for each, value in vars(module).items() if _is_own(value, role, module)]
        remedy = f"there is {', '.join(there)}" if there else f"{place} has none"
        raise BadInput(source, key, name, expected, remedy)
    lacks = [
        method
        for method in _REQUIRED[role]
        if not any(method in vars(each) for each in named.__mro__ if each not in role.__mro__)
    ]
    if lacks:
        raise BadInput(source, key, name, f"a class with the method {lacks[0]}, see hil docs own-controller")
    return named


def _is_own(value: object, role: type, module: ModuleType) -> bool:
    return isinstance(value, type) and issubclass(value, role) and value.__module__ == module.__name__


def _placed(error: BaseException, place: str) -> str:
    """Return an error of loading ``place`` in words, with the line at which it arose."""
    if isinstance(error, SyntaxError) and error.filename and error.lineno:
        line = (error.text or "").strip()
        return f"{Path(error.filename).name}:{error.lineno}: {type(error).__name__}: {error.msg}: {line}"
    name = Path(place).name
    lines = [f"{name}:{line}" for file, line, _ in _frames(error) if Path(file).name == name]
    return ": ".join([*lines[-1:], told(error)])


def object_of(name: str) -> Any:
    """Return the object that ``name`` names, see :data:`OBJECT_PATTERN`; runs its module. Raises whatever
    that raises."""
    return getattr(_loaded(name), name.rpartition(":")[2])


def _loaded(name: str) -> ModuleType:
    remember_modules()
    with held_process():
        return _module_of(name)


class _FromSource(SourceFileLoader):
    """Ignores compiled code beside the file, which counts as current if second and size match: the recorded
    source is what runs."""

    def get_code(self, fullname: str) -> CodeType:
        """Return the code, compiled from source."""
        path = self.get_filename(fullname)
        code: CodeType = self.source_to_code(self.get_data(path), path)
        return code


def _module_of(name: str) -> ModuleType:
    place, _, _ = name.rpartition(":")
    if not place.endswith(".py"):
        return importlib.import_module(place)
    path = Path(place).resolve()
    name = f"{_FILES}{path}"
    spec = importlib.util.spec_from_file_location(name, path, loader=_FromSource(name, str(path)))
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be read as Python")
    module = importlib.util.module_from_spec(spec)
    OWN_FILES.add(str(path))
    sys.modules[spec.name] = module  # where dataclasses and inspect look for it
    beside = str(path.parent)
    sys.path.insert(0, beside)  # as a program finds what is beside it
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(beside)
    return module


class _Watchdog:
    """Interrupts the main thread in a call that does not come back.

    By a signal from a thread that sleeps: a timer of the process would be taken from whoever else has set
    one. A call in another thread is not interrupted, as no signal comes to it.
    """

    def __init__(self) -> None:
        self._clock = MonotonicClock()
        self._due: Instant | None = None
        """By when the present call must be over; None between calls."""
        self._watches = False

    def begin(self, patience_s: float) -> None:
        """A call begins in this thread."""
        if threading.current_thread() is not threading.main_thread():
            return
        if not self._watches:
            self._watches = True
            signal.signal(_SIGNAL, self._interrupt)
            threading.Thread(target=self._watch, daemon=True).start()
        self._due = Instant(self._clock.now() + round(patience_s * NS_PER_S))

    def end(self) -> None:
        """It is over."""
        self._due = None

    def _is_late(self) -> bool:
        due = self._due
        return due is not None and self._clock.now() > due

    def _interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self._is_late():
            self._due = None
            raise _TookTooLong

    def _watch(self) -> None:
        pause = threading.Event()
        main = threading.main_thread().ident
        assert main is not None
        while not pause.wait(_LOOK_S):
            if self._is_late():
                signal.pthread_kill(main, _SIGNAL)


_WATCHDOG: Final = _Watchdog()
"""One for the process, like its signals."""


class _Guard:
    """Around the calls of one object."""

    def __init__(self, what: str, inner: object, setup: Setup) -> None:
        self._what = f"{setup.axis}: the {what} {type(inner).__name__}"
        self._file = inspect.getsourcefile(type(inner)) or ""
        OWN_FILES.add(self._file)
        self._inner = inner
        self._patience_s = setup.patience_s

    @contextmanager
    def watching(self) -> Iterator[None]:
        """A call of the object. Raises OwnCodeFailed."""
        enter_call()
        try:
            _WATCHDOG.begin(self._patience_s)
            yield
        except OwnCodeFailed:
            raise  # of its observer
        except _TookTooLong as error:
            raise OwnCodeFailed(
                f"{self._what} did not come back within {self._patience_s:g} s: {self._line_of(error)}"
            ) from error
        except BaseException as error:  # stop signals raise nothing during a run: it is the object's own
            raise OwnCodeFailed(f"{self._what} failed: {self._line_of(error)}: {told(error)}") from error
        finally:
            _WATCHDOG.end()
            leave_call()

    def refuse(self, method: str, answer: object, expected: str) -> NoReturn:
        """Raise OwnCodeFailed: the result of ``method`` is unusable."""
        code = getattr(type(self._inner), method).__code__
        place = f"{Path(code.co_filename).name}:{code.co_firstlineno} in {method}"
        raise OwnCodeFailed(
            f"{self._what} failed: {place} returned {in_words(answer, repr)}, expected {expected}"
        )

    def _line_of(self, error: BaseException) -> str:
        """The innermost line of the object's own file, else the innermost of all."""
        frames = list(_frames(error))
        own = [frame for frame in frames if frame[0] == self._file]
        if not frames:  # arguments that it does not take; or code that is not Python
            return "in the call itself"
        file, line, function = (own or frames)[-1]
        return f"{Path(file).name}:{line} in {function}"


def _frames(error: BaseException) -> Iterator[tuple[str, int, str]]:
    for frame, line in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_filename != __file__:
            yield frame.f_code.co_filename, line, frame.f_code.co_name


class _GuardedController(Controller):
    """See :func:`guarded_controller`."""

    def __init__(self, inner: Controller, setup: Setup) -> None:
        self._inner = inner
        self._guard = _Guard("controller", inner, setup)
        with self._guard.watching():
            channels = inner.channels()
            observer = inner.observer()
        if not isinstance(channels, tuple | list):
            self._guard.refuse("channels", channels, "a tuple of names")
        self._channels = tuple(channels)
        self._observer = None if observer is None else _GuardedCompensator(observer, setup)

    def channels(self) -> Sequence[str]:
        return self._channels

    def observer(self) -> Compensator | None:
        return self._observer

    def reset(self) -> None:
        with self._guard.watching():
            self._inner.reset()

    def output(self, context: Context) -> SetPoint:
        with self._guard.watching():
            asked = self._inner.output(context)
        if not isinstance(asked, SetPoint):
            self._guard.refuse("output", asked, "a TorqueSetPoint, SpeedSetPoint or PositionSetPoint")
        if not all(map(math.isfinite, values_of(asked))):  # type: ignore[arg-type]
            self._guard.refuse("output", asked, "a number")
        return asked

    def update(self, context: Context, command: Command) -> None:
        with self._guard.watching():
            self._inner.update(context, command)

    def telemetry(self) -> Sequence[float]:
        with self._guard.watching():
            answer = self._inner.telemetry()
            values = [float(value) for value in answer] if isinstance(answer, Iterable) else None
        if values is None:
            self._guard.refuse("telemetry", answer, f"a value for each of {self._channels}")
        if len(values) != len(self._channels):
            self._guard.refuse("telemetry", values, f"a value for each of {self._channels}")
        return values


class _GuardedCompensator(Compensator):
    """See :func:`guarded_compensator`."""

    def __init__(self, inner: Compensator, setup: Setup) -> None:
        self._inner = inner
        self._guard = _Guard("compensator", inner, setup)

    def reset(self) -> None:
        with self._guard.watching():
            self._inner.reset()

    def receive(self, sample: Sample) -> None:
        with self._guard.watching():
            self._inner.receive(sample)

    def sent(self, command: Command) -> None:
        with self._guard.watching():
            self._inner.sent(command)

    def estimate(self, context: Context) -> StateEstimate:
        with self._guard.watching():
            estimate = self._inner.estimate(context)
        if not isinstance(estimate, StateEstimate):
            self._guard.refuse("estimate", estimate, "a StateEstimate")
        return estimate


def guarded_controller(name: str, parameters: Mapping[str, Any], setup: Setup) -> Controller:
    """A controller of the class that ``name`` says, made as ``NAME(setup, **parameters)``.

    Its calls raise OwnCodeFailed, as this does where ``channels`` or ``observer`` raises. Raises BadInput for
    a class that cannot be had or made, and for channels that cannot be recorded.
    """
    made = _GuardedController(_made(Controller, name, parameters, setup), setup)
    channels = made.channels()
    if len(channels) > CHANNELS_MAX or not all(map(_CHANNEL.fullmatch, channels)):
        expected = f"at most {CHANNELS_MAX} names of small letters, digits and _"
        raise BadInput(name, "channels", channels, expected)
    return made


def guarded_compensator(name: str, parameters: Mapping[str, Any], setup: Setup) -> Compensator:
    """A compensator, as :func:`guarded_controller`."""
    return _GuardedCompensator(_made(Compensator, name, parameters, setup), setup)
