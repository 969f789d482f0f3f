"""What every test may use: the command line in this process, walking data, a micro model."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from tests.support.walking import MICRO_SETTINGS, stage, train_here, write_walks

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ["PERSIST_REFERENCE"] = os.devnull  # tests bring their own model; those of the packaged one say so
os.environ.setdefault("OMP_NUM_THREADS", "1")  # micro models are slower on many threads than on one
torch.set_num_threads(1)
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a shell's background job, and commands would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)


DIFFUSERS_MARKERS = (  # of diffusers' own tests, which test_diffusers_mixins runs where there is a checkout
    "attention", "autoround", "big_accelerator", "bitsandbytes", "cache", "compile", "context_parallel", "cpu_offload",
    "gguf", "group_offload", "ip_adapter", "lora", "memory", "modelopt", "nightly", "quantization", "quanto", "sdnq",
    "single_file", "tensor_parallel", "torchao", "training",
)  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """Know the marks of what a checkout brings."""
    for name in DIFFUSERS_MARKERS if os.environ.get("DIFFUSERS_CHECKOUT") else ():
        config.addinivalue_line("markers", f"{name}: of diffusers' own tests")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what wants a CUDA device where there is none, before its fixtures train anything."""
    device = getattr(getattr(item, "module", None), "DEVICE", "cuda")  # test_on_gpu may be told another
    if item.get_closest_marker("gpu") and device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device here")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


Persist = Callable[..., Ended]


@pytest.fixture
def persist(capsys: pytest.CaptureFixture[str]) -> Persist:
    """The command line, run in this process."""
    from persist_cli.cli.app import main

    def run(*arguments: object) -> Ended:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in arguments])
        printed = capsys.readouterr()
        return Ended(int(ended.value.code or 0), printed.out, printed.err)

    return run


@pytest.fixture
def fresh_accelerator() -> Iterator[None]:
    """Accelerate fixes the precision of a process by its first accelerator; here it may be another."""
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture(scope="session")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two 32×32 walks of 24 frames through the furnished room, there and back, by named actions."""
    return write_walks(tmp_path_factory.mktemp("walks"))


@pytest.fixture(scope="session")
def codec(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A codec run of four steps of the micro model."""
    run = tmp_path_factory.mktemp("runs") / "codec"
    train_here(*stage("codec", walks, run, *MICRO_SETTINGS))
    return run


@pytest.fixture(scope="session")
def stage1(walks: Path, codec: Path) -> Path:
    """A stage-1 run of four steps on it."""
    train_here(*stage("stage1", walks, codec.parent / "stage1", f"base={codec}"))
    return codec.parent / "stage1"


@pytest.fixture(scope="session")
def voxel(walks: Path, stage1: Path) -> Path:
    """A stage-2 run with a voxel memory on that."""
    train_here(*stage("stage2-voxel", walks, stage1.parent / "voxel", f"base={stage1}"))
    return stage1.parent / "voxel"
