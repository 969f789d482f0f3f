"""Fixtures of all tests: the command line in this process, a small data set, and trained micro models."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from persist_cli.train.log import StepLog
from tests.support.cell_houses import FORM, write_cell_houses
from tests.support.micro_policies import policy_stage
from tests.support.micro_runs import MICRO_SETTINGS, run_persist, stage, write_loops, write_walks

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ["PERSIST_REFERENCE"] = os.devnull  # tests bring their own model, unless they test the packaged one
os.environ.setdefault("OMP_NUM_THREADS", "1")  # micro models are slower on many threads than on one
torch.set_num_threads(1)
for name, handler in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    number = getattr(signal, name, None)  # Windows has no SIGHUP
    if number is not None and signal.getsignal(number) == signal.SIG_IGN:  # in a background job, and under nohup
        signal.signal(number, handler)  # or the commands of tests would inherit it


DIFFUSERS_MARKERS = (  # of diffusers' own tests, which test_diffusers_mixins runs where there is a checkout
    "attention", "autoround", "big_accelerator", "bitsandbytes", "cache", "compile", "context_parallel", "cpu_offload",
    "gguf", "group_offload", "ip_adapter", "lora", "memory", "modelopt", "nightly", "quantization", "quanto", "sdnq",
    "single_file", "tensor_parallel", "torchao", "training",
)  # fmt: skip


LONGEST = (  # files that take a minute or more begin first, so that none is left to one process at the end
    "test_documented_commands.py", "test_doctor.py", "test_processes.py", "test_finetune.py", "test_collect.py",
    "test_without_extras.py", "test_memory_savings.py", "test_plan_bench.py", "test_pipeline.py", "test_bundled.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of the longest files first."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.name, len(places)))


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers of diffusers' own tests."""
    for name in DIFFUSERS_MARKERS if os.environ.get("DIFFUSERS_CHECKOUT") else ():
        config.addinivalue_line("markers", f"{name}: of diffusers' own tests")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip tests of a CUDA device where there is none, before their fixtures train anything."""
    device = getattr(getattr(item, "module", None), "DEVICE", "cuda")  # test_on_gpu can run on another one
    if item.get_closest_marker("gpu") and device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device here")


@dataclass(frozen=True)
class CommandResult:
    """Exit code, standard output and standard error of a command."""

    code: int
    out: str
    err: str


Persist = Callable[..., CommandResult]


@pytest.fixture
def persist(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Persist:
    """The command line, run in this process, in a folder of its own: where a command writes by default is locked."""
    from persist_cli.cli.app import main

    monkeypatch.chdir(tmp_path_factory.mktemp("cwd"))

    def run(*arguments: object) -> CommandResult:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return CommandResult(int(ended.value.code or 0), printed.out, printed.err)

    return run


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the module path, like site-packages."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    return folder


@pytest.fixture
def fresh_accelerator() -> Iterator[None]:
    """Let a test choose a precision, which accelerate else fixes for a process by its first accelerator."""
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture(scope="session", autouse=True)
def draw_loss() -> Iterator[Callable[[StepLog, Path], None]]:
    """What draws the loss of a run, which few tests look at: for others the file is made empty."""
    drawn = StepLog.draw
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StepLog, "draw", lambda self, path: path.touch())
        yield drawn


class HereExecutor(Executor):
    """Runs what is submitted at once and in this process, where a new worker would import for seconds."""

    def __init__(self, _workers: int, _context: Any, initializer: Callable[..., None], initargs: tuple[Any, ...]):
        initializer(*initargs)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Run a function; its result or error."""
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **options))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture
def collecting_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let ``persist collect`` walk in this process."""
    from persist_cli.simulators import collect

    monkeypatch.setattr(collect, "ProcessPoolExecutor", HereExecutor)
    monkeypatch.setattr(collect, "_worker", {})


@pytest.fixture(scope="session")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two 32×32 walks of 24 frames through the furnished room, there and back, by named actions."""
    return write_walks(tmp_path_factory.mktemp("walks"))


@pytest.fixture(scope="session")
def held_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two 32×32 walks of 24 frames in scenes that no model was trained on; they come back another way."""
    return write_loops(tmp_path_factory.mktemp("held-out"))


@pytest.fixture(scope="session")
def codec(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A codec run of four steps of the micro model."""
    run = tmp_path_factory.mktemp("runs") / "codec"
    run_persist(*stage("codec", walks, run, *MICRO_SETTINGS))
    return run


@pytest.fixture(scope="session")
def stage1(walks: Path, codec: Path) -> Path:
    """A stage-1 run of four steps on that codec."""
    run_persist(*stage("stage1", walks, codec.parent / "stage1", f"base={codec}"))
    return codec.parent / "stage1"


@pytest.fixture(scope="session")
def voxel(walks: Path, stage1: Path) -> Path:
    """A stage-2 run of four steps with a voxel memory on that stage-1 run."""
    run_persist(*stage("stage2-voxel", walks, stage1.parent / "voxel", f"base={stage1}"))
    return stage1.parent / "voxel"


@pytest.fixture(scope="session")
def policy_run(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a policy's micro network of four steps."""
    run = tmp_path_factory.mktemp("policies") / "policy"
    run_persist(*policy_stage(walks, run))
    return run


@pytest.fixture(scope="session")
def cell_houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two houses to measure in."""
    return write_cell_houses(tmp_path_factory.mktemp("cells") / "test", [5, 7])


@pytest.fixture(scope="session")
def training_cell_houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five other houses."""
    return write_cell_houses(tmp_path_factory.mktemp("cells") / "train", [2, 4, 6, 8, 10])


@pytest.fixture(scope="session")
def scene_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of the houses' classes that was not trained."""
    from persist_cli.checkpoints.scene_models import save_scene_model
    from tests.support.micro_scenes import micro_model

    folder = tmp_path_factory.mktemp("models") / "scene"
    folder.mkdir()
    model = micro_model(palette=list(FORM.palette), shape=[16, 16, 12])
    model.name = "scene"
    save_scene_model(model, "scene", folder, None)
    return folder


@pytest.fixture(scope="session")
def scene_renderer(training_cell_houses: Path, stage1: Path) -> Path:
    """A stage-2 run of four steps of an adapter that draws scenes."""
    run = stage1.parent / "scene"
    memory = {"name": "scene", "settings": {"palette": list(FORM.palette)}, "encoder": "classes"}
    changes = [f"memory={json.dumps(memory)}", "adapter.form=rendered", "data.true_cells=1", "data.mirror=false"]
    run_persist(*stage("stage2-voxel", training_cell_houses, run, f"base={stage1}", *changes))
    return run
