"""Command line: ``hood COMMAND key=value …``. User errors are one line and exit code 2."""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hood import plugins
from hood.assets.files.said import DISTRIBUTION, listening

# For the C library and OpenMP. Cloth steps allocate and free tensors of a few MB many times a frame: keeping them mapped is
# worth 1.15–1.9×. Waiting threads that spin slow a busy machine down 6× and more. Both figures and the times below are of an
# AMD server CPU.
ENVIRONMENT = {
    "OMP_WAIT_POLICY": "PASSIVE",
    # One step of a 1k garment takes 45 ms on one thread and 100 ms on two: its operations are too small to share.
    "OMP_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": "1073741824",
    "MALLOC_TRIM_THRESHOLD_": "1073741824",
    "MALLOC_TOP_PAD_": "67108864",
}
#: The numbers that ``mallopt`` of the GNU C library has for them.
_OF_MALLOPT = {"MALLOC_TRIM_THRESHOLD_": -1, "MALLOC_TOP_PAD_": -2, "MALLOC_MMAP_THRESHOLD_": -3}
COMMANDS = {
    "rollout": "simulate garments on a moving body: positions, a film, a verdict",
    "dress": "simulate a data set: garments on bodies in many motions, on all cores or a cluster",
    "view": "write rollouts as one HTML page to turn and play in a browser",
    "compare": "film rollouts of one motion side by side, coloured by strain, unbalanced force or distance",
    "export": "write a rollout for other programs: USD, glTF, PC2, OBJ, PLY",
    "inspect": "say what files are, what is wrong with them and how to repair it",
    "prepare": "repair a garment, fit it to a body and write it for rollouts",
    "sew": "sew a pattern around a body: the garment, its sheet, and a verdict",
    "fabric": "compare fabrics, and drape them over a disc",
    "fit": "find fabric, size, friction and wind from frames that were seen, with intervals",
    "sizes": "show several sizes of a garment on several bodies: how each sits, and one sheet",
    "plan": "measure which parts of the model a scene needs, and what each costs",
    "train": "train a network",
    "evaluate": "measure cost and accuracy of networks and of the solver, as a table",
    "tradeoff": "measure time against accuracy for many settings, as a chart",
    "envelope": "measure where each method holds and fails, in extreme scenes, as a map",
    "convert": "write published HOOD weights (.pth) and rollouts (.pkl) as files of this library, and rollouts back",
}

#: Where each of them lives; the others, and those of installed packages, are registered (:mod:`hood.plugins`).
_HOMES = {
    "rollout": "hood.cli.rollout:run",
    "dress": "hood.cli.rollout:dressed",
    "view": "hood.cli.export:write_page",
    "compare": "hood.cli.compare:run",
    "export": "hood.cli.export:run",
    "inspect": "hood.cli.inspect.inspect:run",
    "prepare": "hood.cli.prepare.prepare:run",
    "sew": "hood.cli.sew:run",
    "fabric": "hood.cli.fabric:run",
    "fit": "hood.cli.rollout:fitted",
    "sizes": "hood.cli.sew:sizes",
    "train": "hood.cli.rollout:train",
    "evaluate": "hood.cli.evaluate:run",
    "convert": "hood.cli.export:convert",
}

#: Where several hold, 130 comes before 2, and 2 before 3.
EXIT_CODES = {
    0: "done",
    1: "inspect: something needs repair; tradeoff: points failed, the page is without them",
    2: "an error, in one line; rollout: a motion of many could not be used; dress: too many rows failed; train -m: a run",
    3: "rollout: unsound, doubtful with fail_on=doubts, or guard=strict; dress: too many; sew: badly; fit: not converged",
    130: "interrupted; what is done is kept",
}

_LESS_MEMORY = "free some, raise the limit (ulimit -v), or take a smaller garment, fewer frames or a smaller model"

#: Words with dashes of commands that take steps; others ask what a command would do.
_SWEEP = ("-m", "--multirun")
#: Commands that take steps: libraries for these are compiled while torch is loaded, where that has not been done before.
_SIMULATE = ("train", "rollout", "dress", "evaluate", "tradeoff", "envelope", "plan", "fabric", "fit", "sizes", "sew")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code, see :mod:`hood.app.output.verdict`."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return 0
    name, overrides = arguments[0], arguments[1:]
    if name in ("-V", "--version"):
        from hood import __version__

        print(f"hood {__version__} ({DISTRIBUTION})")
        return 0
    if name not in COMMANDS and name not in plugins.names("commands"):
        from hood.assets.files.library import unknown

        return _fail(unknown("command", name, [*COMMANDS, *plugins.names("commands")]))
    if name in COMMANDS and any(word in ("-h", "--help") for word in overrides):
        from hood.cli.help import describe

        print("\n".join([describe(name), "", *exit_code_lines()]))
        return 0
    return _run(name, overrides)


def script(name: str) -> None:
    """Entry of ``scripts/<name>.py``: the command ``name`` with the script's arguments."""
    entry([name, *sys.argv[1:]])


def aloud(sentence: str, error: bool, passing: bool) -> None:
    """Print what is said while a command runs, see :func:`hood.assets.files.said.say`."""
    print(sentence, file=sys.stderr if error else sys.stdout, flush=passing)


def _run(name: str, overrides: Sequence[str]) -> int:
    try:
        command = _command(name, overrides)
        if not gc.isenabled():  # see entry()
            gc.freeze()
            gc.enable()
        from hood.app.common import GivenUpError
        from hood.app.notices import heard

        try:
            with listening(aloud), heard():
                return command(overrides)
        except GivenUpError:  # it has said why
            return 2
    except KeyboardInterrupt:
        print("hood: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # see entry()
        raise
    except (ValueError, OSError, ImportError) as error:
        if os.environ.get("HOOD_TRACEBACK"):
            raise
        return _fail(_describe(error))
    except (MemoryError, RuntimeError) as error:
        if os.environ.get("HOOD_TRACEBACK") or not _is_memory(error):
            raise
        return _fail(f"the memory is used up; {_LESS_MEMORY}")


def _is_memory(error: Exception) -> bool:
    """Whether an error says that there is no memory left; torch says it in a RuntimeError, on a CPU in one without a class."""
    return isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error)


def _describe(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename and error.strerror:
        hints = {
            2: "check the path",
            13: "choose a folder you may write to",
            17: "choose another output",
            20: "choose another output",
            28: "free some space or choose another output",
            27: "raise the limit on the size of files (ulimit -f)",
            30: "choose another output",
        }
        hint = hints.get(error.errno or 0)
        return f"{error.filename}: {error.strerror.lower()}" + (f"; {hint}" if hint else "")
    text = " ".join(str(error).split()) or type(error).__name__
    # A library that does not fit into the address space; the loader of the system has no class or number for it.
    return f"{text}; {_LESS_MEMORY}" if "failed to map segment" in text else text


def _fail(message: str) -> int:
    print(f"hood: error: {message}", file=sys.stderr)
    return 2


def _command(name: str, words: Sequence[str]) -> Callable[[Sequence[str]], int]:
    from importlib import import_module

    if name in COMMANDS and any(word.startswith("-") for word in words):
        from hood.cli.help import answer, asks

        if asks(words):
            return partial(answer, name)
    module, _, function = _HOMES.get(name, "").partition(":")
    run: Callable[[Sequence[str]], int] = getattr(import_module(module), function) if module else plugins.find("commands", name)
    gc.freeze()  # modules stay until the end: looking through them for garbage is 4% of a solver's frame
    return run


def exit_code_lines() -> list[str]:
    """The table for a terminal."""
    return [
        "exit codes (where several hold: 130, then 2, then 3):",
        *(f"  {code:<6}{text}" for code, text in EXIT_CODES.items()),
    ]


def _usage() -> str:
    lines = ["usage: hood COMMAND [key=value ...]", ""]
    lines += [f"  {name:<10}{text}" for name, text in COMMANDS.items()]
    further = [name for name in plugins.names("commands") if name not in COMMANDS]
    lines += [f"  {name:<10}of the installed package {plugins.origin('commands', name)}" for name in further]
    lines += [
        "",
        "hood COMMAND --help lists the keys, their defaults and the names that can be given.",
        "hood --version: the version.",
        "",
    ]
    lines += ["begin with: hood rollout garment=dress sequence=walk_proud output=outputs/first", "", *exit_code_lines()]
    return "\n".join(lines)


def entry(argv: Sequence[str] | None = None) -> None:
    """Console entry: the process is set up before torch is loaded, then runs the command and ends with its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    gc.disable()  # while modules are read: they stay anyway, and to look for garbage among them takes half a second
    leave_working_folder()
    _name_program()
    if sys.platform.startswith("linux"):
        _keep_memory_mapped()
    from hood.native import build

    build.announce = lambda sentence: print(f"hood: {sentence}", file=sys.stderr)
    if arguments and arguments[0] in _SIMULATE and not any(word[:1] == "-" and word not in _SWEEP for word in arguments):
        build.start()
    try:
        code = main(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # who reads, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 130
    sys.exit(code)


def leave_working_folder() -> None:
    """Import nothing from the folder where the command is called, here and in every Python that is started from here.

    ``python -m`` and ``python -c`` put it first: a file ``yaml.py`` there would be run. ``PYTHONPATH`` stays. Of a clone that
    is not installed, hood itself is found there still, after everything else.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        here = os.getcwd()
    except FileNotFoundError:  # it has been removed since
        here = ""
    if sys.flags.safe_path or not sys.path or sys.path[0] not in ("", here):
        return
    del sys.path[0]
    home = str(Path(__file__).parents[2])
    if home == here and home not in sys.path:
        sys.path.append(home)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), home]))


def _name_program() -> None:
    """Tell processes that this one spawns, as trainings do, that it is ``python -m hood``: they would import the script that
    called us to begin with, and one without a guard would start the command again."""
    main = sys.modules["__main__"]
    if getattr(main, "__spec__", None) is None:
        main.__spec__ = importlib.util.find_spec("hood.__main__")


def _keep_memory_mapped() -> None:
    """Apply :data:`ENVIRONMENT`, what the user has set before it: to this process now, to those that it starts by their
    environment. OpenMP reads its part when torch is loaded."""
    missing = {key: value for key, value in ENVIRONMENT.items() if not os.environ.get(key)}
    os.environ.update(missing)
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # not every C library has it
    for key, number in _OF_MALLOPT.items():
        if mallopt is not None and key in missing:
            mallopt(number, int(missing[key]))


if __name__ == "__main__":
    entry()
