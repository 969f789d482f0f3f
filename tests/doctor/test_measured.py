"""The doctor's estimates are within 15 % of what runs take, at three sizes and in both precisions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from persist_cli.doctor.memory_estimate import Launch
from persist_cli.doctor.meta_model import build_meta_model
from tests.support import resident_memory as resident
from tests.support.measured_memory import SHORT, Run, measured_peaks, trained_bytes
from tests.support.micro_runs import run_persist, write_walks

WITHIN = 0.15
CHECKPOINTING = "training.gradient_checkpointing=true"
PLAIN = ["training.precision=no", "training.vae_slicing=true"]
HALF = ["training.precision=bf16", "training.vae_slicing=true"]
TWIN_OF_5B = (
    "backbone.settings.transformer={num_attention_heads: 8, num_layers: 10, time_embed_dim: 512, in_channels: 32, "
    "out_channels: 16, text_embed_dim: 32, max_text_seq_length: 1, spatial_interpolation_scale: 1.0, "
    "use_rotary_positional_embeddings: true}"
)


def computes_in_bf16() -> bool:
    """Whether the processor multiplies in bf16 itself; else that is many times slower than in float32."""
    cpuinfo = Path("/proc/cpuinfo")
    known = set(cpuinfo.read_text().split()) if cpuinfo.is_file() else set()
    return bool(known & {"avx512_bf16", "amx_bf16", "bf16"})


pytestmark = pytest.mark.skipif(not resident.KNOWN, reason="only Linux tells the peak memory")


@pytest.fixture(scope="module")
def walks_of(tmp_path_factory: pytest.TempPathFactory):
    """Settings of a backbone for square images, and walks of that size."""

    def make(size: int) -> tuple[str, list[str]]:
        folder = tmp_path_factory.getbasetemp() / f"walks-{size}"
        if not folder.exists():
            folder.mkdir()
            write_walks(folder, size)
        return str(folder), [f"backbone.settings.height={size}", f"backbone.settings.width={size}"]

    return make


def estimate(run: Run, cuda: bool = False) -> int:
    recipe, _, settings = run
    meta_model = build_meta_model(recipe, [*SHORT, *settings])
    return meta_model.estimator().estimate(meta_model.recipe, Launch(devices=1, cuda=cuda)).peak


def trained_stage1(data: str, settings: list[str]) -> Path:
    out = Path(data).parent / "stage1"
    run_persist("finetune", "tiny-stage1", "--data", data, "--out", str(out), *SHORT, *settings)
    return out


def check(runs: Sequence[Run]) -> None:
    for run, measured in zip(runs, measured_peaks(runs), strict=True):
        assert estimate(run) == pytest.approx(measured, rel=WITHIN), run[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",  # activations then take most of the memory
    [["training.batch=4"], ["training.batch=2", CHECKPOINTING]],
    ids=["plain", "checkpointing"],
)
def test_estimates_hold_for_a_tiny_model(walks_of, change):
    data, settings = walks_of(64)
    check([("tiny-stage1", data, [*settings, *PLAIN, *change])])


@pytest.mark.slow
@pytest.mark.parametrize("size", [96, 128])
def test_estimates_hold_for_larger_images(walks_of, size):
    data, settings = walks_of(size)
    tiny = [*settings, *PLAIN, "training.batch=2"]
    check([("tiny-stage1", data, [*tiny, *change]) for change in ([], [CHECKPOINTING])])


@pytest.mark.slow
@pytest.mark.parametrize(
    "precision",
    [
        pytest.param(PLAIN, id="float32"),
        pytest.param(
            HALF,
            id="bf16",
            marks=pytest.mark.skipif(not computes_in_bf16(), reason="no units for bf16: it would take ten minutes"),
        ),
    ],
)
def test_estimates_hold_for_a_small_twin_of_the_large_model(walks_of, precision):
    data, settings = walks_of(64)
    twin = [*settings, *precision, "training.batch=4", TWIN_OF_5B]
    check([("tiny-stage1", data, [*twin, *change]) for change in ([], [CHECKPOINTING])])


@pytest.mark.slow
def test_estimates_hold_for_8_bit_moments(walks_of):
    pytest.importorskip("bitsandbytes")
    data, settings = walks_of(64)
    twin = [*settings, *PLAIN, "training.batch=4", TWIN_OF_5B, "training.optimizer=adamw-8bit"]
    check([("tiny-stage1", data, [*twin, *change]) for change in ([], [CHECKPOINTING])])


@pytest.mark.slow
def test_estimates_hold_where_encoding_takes_most_and_for_the_codec(walks_of):
    (data, settings), (smaller, half) = walks_of(128), walks_of(64)
    codec = [*half, "training.precision=no", "training.batch=4", "backbone.settings.codec_window=null"]
    check([("tiny-stage1", data, [*settings, "training.precision=no", "training.batch=4", CHECKPOINTING]),
           ("tiny-codec", smaller, codec)])  # fmt: skip


@pytest.mark.slow
def test_estimates_hold_for_a_memory_adapter_and_for_lora(walks_of):
    data, settings = walks_of(64)
    run = [*settings, *PLAIN, "training.batch=8", TWIN_OF_5B]
    stage1 = trained_stage1(data, run)
    run.remove(TWIN_OF_5B)
    check([("tiny-stage2-voxel", data, [*run, f"base={stage1}", "adapter={form: cross, width: 128, dropout: 0}"]),
           ("tiny-stage1", data, [*run, f"base={stage1}", "lora={rank: 16}"])])  # fmt: skip


@pytest.mark.gpu
@pytest.mark.parametrize("change", [[], [CHECKPOINTING]], ids=["plain", "checkpointing"])
def test_estimates_hold_on_a_gpu(walks_of, change):
    data, settings = walks_of(64)
    run: Run = ("tiny-stage1", data, [*settings, *HALF, "training.batch=4", TWIN_OF_5B, *change])
    trained_bytes(run, lambda: torch.cuda.max_memory_allocated())
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    assert estimate(run, cuda=True) == pytest.approx(
        trained_bytes(run, lambda: torch.cuda.max_memory_allocated()) - before, rel=WITHIN
    )
