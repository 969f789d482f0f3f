"""Options that several commands take, and the group of commands that ends what is no fault of persist in one line."""

from __future__ import annotations

import codecs
import contextlib
import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Collection, Iterator, MutableMapping
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from persist_cli import __version__
from persist_cli.errors import INTERRUPTED, PersistError
from persist_cli.io.checksums import verifying
from persist_cli.io.command_line import command_line
from persist_cli.io.signals import STOPPING, caught_signals
from persist_cli.plugins import plugin_errors

DISK_ERRORS: Final = {  # of a disk that is full, closed or read-only, which is no fault of a command
    errno.EACCES, errno.EDQUOT, errno.EFBIG, errno.EISDIR, errno.ENAMETOOLONG, errno.ENOSPC, errno.ENOTDIR, errno.EPERM,
    errno.EROFS,
}  # fmt: skip

WORDS: Final = "persist_cli.words"  # key of a context for the words of the command line

SPINS: Final = "3000"  # rounds of busy waiting, some microseconds; tests/benchmarks/bench_spinning.py measures it

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]

CheckpointsArgument = Annotated[
    list[Path] | None, typer.Argument(metavar="CHECKPOINT...", help="Runs or checkpoints; else the reference.")
]

ReferenceArgument = Annotated[
    Path | None, typer.Argument(help="A finetune run, or a checkpoint folder; else the reference model.")
]

PlanSettingsOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="As in method.elites=0.1, policy.KEY=VALUE or cost.KEY=VALUE."),
]

SimulatorSettingsOption = Annotated[
    list[str] | None, typer.Option("--set", help="Of the simulator, where no option has it: radius=0.15.")
]

ImporterSettingsOption = Annotated[
    list[str] | None, typer.Option("--set", help="Of the importer, as in pose=observation.pose.")
]

CemSettingsOption = Annotated[
    list[str] | None, typer.Option("--set", help="Of cem, as in method.elites=0.1 or method.kept=0.3.")
]

LearnSettingsOption = Annotated[
    list[str] | None, typer.Option("--set", help="Of the training, as in training.learning_rate=3e-5.")
]

StepsOption = Annotated[int | None, typer.Option("--steps", min=1, help="Denoising steps; the checkpoint's, else 50.")]

SamplerOption = Annotated[
    str | None, typer.Option("--sampler", help="ddim, dpm, unipc, dpm++ or consistency; the checkpoint's, else ddim.")
]

GuidanceOption = Annotated[
    float | None,
    typer.Option("--guidance", min=0, help="Of guidance over memory; the checkpoint's, else 1: none."),
]

SamplingOfOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="MEMORY:KEY=VALUE,...",
        help="Other sampling of one memory's rows, as in voxel:steps=4,sampler=unipc,guidance=1; may be repeated.",
    ),
]

ContextNoiseOption = Annotated[
    float | None,
    typer.Option(
        "--context-noise",
        min=0,
        help="How noisy the model shall take frame and memory to be; the checkpoint's, else 0.",
    ),
]

AutoguidanceOption = Annotated[
    float | None,
    typer.Option(
        "--autoguidance", min=1, help="Away from the guide, which the checkpoint must have; its own, else 1: none."
    ),
]

StoredTurnOption = Annotated[
    float | None,
    typer.Option("--turn", min=0.001, max=180.0, help="Store walking actions: degrees of a turn."),
]

SkipBadOption = Annotated[
    bool, typer.Option("--skip-bad", help="Leave out frames that cannot be used, and recordings without others.")
]

HoldOutOption = Annotated[
    float,
    typer.Option("--hold-out", help="Share of frames at the end kept for tests: writes OUT/train and OUT/test."),
]

DEFAULT_CONTROLS: Final = "copy,nearest,warp,codec,shuffled,emptied"

MemoriesOption = Annotated[
    str | None,
    typer.Option(
        help="Memories to compare, separated by commas, the first as reference; stage1 is the model without any. By "
        "default none, or stage1 where no checkpoint has it, and the memories of the checkpoints."
    ),
]
ControlsOption = Annotated[
    str | None,
    typer.Option(
        "--controls",
        help="Of copy, nearest, warp, codec, truth, shuffled, emptied, oracle, true-cells, noisy, drifting.",
        show_default=DEFAULT_CONTROLS,
    ),
]

NewPosesOption = Annotated[
    tuple[float, float],
    typer.Option(
        "--new-poses",
        metavar="METRES DEGREES",
        help="A frame counts if no frame in memory is nearer than both; 0 0 counts every frame.",
    ),
]

TrainingScenesOption = Annotated[
    bool, typer.Option("--allow-training-scenes", help="Evaluate scenes of the training, too; results say so.")
]

TrainingSeedsOption = Annotated[
    bool, typer.Option("--training-seeds", help="Checkpoints whose recipes differ in seeds alone are one row.")
]

ResampleOption = Annotated[
    str, typer.Option("--resample", help="What intervals draw: scenes (houses), or clips where all are of one place.")
]

CompareOption = Annotated[
    tuple[Path, Path] | None,
    typer.Option("--compare", metavar="A.json B.json", help="Compare two results instead."),
]

BodyOption = Annotated[
    bool | None,
    typer.Option(
        "--body/--no-body",
        help="Stop at what is in the way, or go through walls; by default stop where the data tell how high the camera "
        "is, as a simulator's do.",
    ),
]

DtypeOption = Annotated[
    str | None, typer.Option("--dtype", help="float32, bfloat16 or float16; the checkpoint's, float32 as a rule.")
]

SaveMemoryOption = Annotated[
    str | None,
    typer.Option("--save-memory", help="Of model-offload, sequential-offload, vae-slicing, vae-tiling, with commas."),
]


def verify_everything(context: typer.Context, verify: bool) -> bool:
    """Let the command of a context verify every file with a checksum, when ``verify`` is set."""
    context.with_resource(verifying(verify))
    return verify


VerifyOption = Annotated[
    bool,
    typer.Option(
        "--verify", callback=verify_everything, help="Check every file by its checksum, not only those up to 256 MiB."
    ),
]

ActionsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--actions",
        help='As in "left*4 forward*6"; given again, another branch. Usual: stay, forward, backward, left, right, '
        "pick_up, drop, toggle; `persist inspect DATA` lists those of DATA.",
    ),
]

StepOption = Annotated[
    float | None,
    typer.Option("--step", min=0.001, help="Metres of forward and backward; DATA's own, else 0.25 with --turn."),
]

TurnOption = Annotated[
    float | None,
    typer.Option("--turn", min=0.001, max=180.0, help="Degrees of left and right; DATA's own, else 15 with --step."),
]


def limit_spinning(environment: MutableMapping[str, str]) -> None:
    """Let torch's OpenMP threads give up their core soon when they wait, unless the user chose how they wait.

    By default they wait busily for so long that small models are many times slower beside other processes. It must be
    called before torch is imported; child processes inherit it.
    """
    if not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & environment.keys():
        environment["GOMP_SPINCOUNT"] = SPINS


def open_closed_streams() -> None:
    """Let what is printed go nowhere where the caller has closed standard output or error, as some services do."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  it stays open


def outlive_listeners() -> None:
    """Let a command go on when its terminal is closed, or when the program that reads its standard error has ended.

    That may be before a training saves, as when Ctrl-C also ends ``tee``. Only where a program reads standard output is
    its end that of the command, as in ``persist recipes | head``.
    """
    for name, unheard in (("stdout", (errno.EIO,)), ("stderr", (errno.EIO, errno.EPIPE))):
        stream = getattr(sys, name)
        if os.name == "posix" and isinstance(stream, io.TextIOWrapper) and stream is getattr(sys, f"__{name}__"):
            buffer = io.BufferedWriter(_PerhapsUnheard(stream.fileno(), unheard))
            heard = io.TextIOWrapper(buffer, stream.encoding, stream.errors, None, stream.line_buffering)
            setattr(sys, name, heard)


class _PerhapsUnheard(io.FileIO):
    """A file that takes what is written as written when it refuses it with one of some errors."""

    def __init__(self, number: int, errors: Collection[int]) -> None:
        super().__init__(number, "w", closefd=False)
        self.errors = errors

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in self.errors:
                raise
            return len(data)


def print_any_letter() -> None:
    """Let standard output show question marks for letters that its encoding lacks, and any file name as it is.

    By default the first such letter ends a command with a traceback, after its work: in a pipe on Windows, in a locale
    without UTF-8, and where the name of a file is not UTF-8.
    """
    out = sys.stdout
    if isinstance(out, io.TextIOWrapper) and out.errors in ("strict", "surrogateescape"):
        is_utf = codecs.lookup(out.encoding).name.startswith("utf")
        out.reconfigure(errors="surrogateescape" if is_utf else "replace")


def split_names(text: str) -> tuple[str, ...]:
    """The names in a list separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def refuse_options(context: typer.Context, names: str, why: str) -> None:
    """Raise ``PersistError`` when the command line has options that a command would not use.

    Args:
        context: the command's.
        names: names of their parameters, separated by spaces.
        why: when they may be given, which the message ends with.
    """
    options = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    sources = {options[name]: context.get_parameter_source(name) for name in names.split()}
    given = [option for option, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
    if given:
        raise PersistError(f"{', '.join(given)}: {why}")


def refuse_other_options(context: typer.Context, names: str, why: str) -> None:
    """Raise ``PersistError`` when the command line has other options or arguments than those of some parameters.

    Args:
        context: the command's.
        names: names of the parameters that it uses, separated by spaces.
        why: when the others may be given, which the message ends with.
    """
    unused = [parameter.name for parameter in context.command.params if parameter.name not in names.split()]
    refuse_options(context, " ".join(filter(None, unused)), why)


def show_version(show: bool) -> None:
    """Print the version and end the command, when ``show`` is set."""
    if show:
        typer.echo(f"persist {__version__}")
        raise typer.Exit


class Commands(TyperGroup):
    """Commands that end in one line: a signal with 128 and its number, as in a shell, files or bad plugins with 1."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Read the words of the command line, and keep them for results that say how they were made."""
        words = tuple(args)  # reading takes them out of the list
        context = super().make_context(info_name, args, parent, **extra)
        context.meta[WORDS] = words
        return context

    def invoke(self, ctx: Any) -> Any:
        """Run the command of the context."""
        try:
            with _terminated_like_interrupted(), plugin_errors(), command_line(ctx.meta.get(WORDS, ())):
                return super().invoke(ctx)
        except BrokenPipeError:  # nobody reads what is printed: typer ends quietly
            raise
        except OSError as error:
            raise PersistError(system_error(error)) from error
        except UnicodeEncodeError as error:
            if error.reason != "surrogates not allowed":
                raise
            raise PersistError(f"{shown_name(error)}: holds letters that are not UTF-8; rename it") from error
        except KeyboardInterrupt as stop:
            typer.secho("stopped; what is written is whole, the same command goes on with it or begins anew", err=True)
            raise typer.Exit(128 + stop.number if isinstance(stop, Terminated) else INTERRUPTED) from None


def system_error(error: OSError) -> str:
    """One line about what a file, a disk or the network refused."""
    if error.errno in DISK_ERRORS:
        place = error.filename or "a file cannot be written"
        return f"{place}: {error.strerror}; make room there, or choose another place"
    if error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def shown_name(error: UnicodeEncodeError) -> str:
    """The line around a letter of a file's name that is not UTF-8, in which the letter is a question mark."""
    start = error.object.rfind("\n", 0, error.start) + 1
    return error.object[start:].splitlines()[0].encode(errors="replace").decode()


class Terminated(KeyboardInterrupt):
    """A signal that ends a command like Ctrl-C: what it writes aside is removed and its processes are ended.

    Args:
        number: the signal's.
    """

    def __init__(self, number: int) -> None:
        self.number = number


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP raise ``Terminated``, as Ctrl-C raises ``KeyboardInterrupt``."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Terminated(number)

    if threading.current_thread() is not threading.main_thread():  # no other may change what a signal does
        yield
        return
    with caught_signals(stop, {*STOPPING} - {signal.SIGINT}):
        yield
