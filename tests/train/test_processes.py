"""Two processes with gloo on the CPU: with DDP and FSDP2 they train what one process trains."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from accelerate import PartialState

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import load_backbone, start_backbone
from persist_cli.errors import PersistError
from persist_cli.io.files import read_tensors
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.train.distributed import Sharding, fsdp_plugin
from persist_cli.train.sources import with_computed_settings
from persist_cli.train.state import read_shards
from tests.support.damage import without_sums
from tests.support.micro_model import micro, with_adapter
from tests.support.micro_runs import (
    MICRO_SETTINGS,
    equal_runs,
    first_gradients,
    losses,
    run_persist,
    run_result,
    stage,
    two_process_launch,
)
from tests.support.processes import run_command, run_in_pair, start_pair, wait_until
from tests.support.text_encoder import write_text_encoder
from tests.support.twins import load_twin, write_twin
from tests.support.two_processes import job, run_in_two
from tests.train.test_clip_cache import FEW, share_cached
from tests.train.test_own_writes import OWN

FSDP = {"ACCELERATE_USE_FSDP": "true", "FSDP_VERSION": "2"}

KINDS = {"ddp": {}, "fsdp": FSDP}

BATCH = "training.batch=4"

CLIP = 0.01  # less than the norm of any step's gradients here

NEAR = 2e-5  # between weights, which four steps of these learning rates can change by 1.4e-3

BF16 = "training.precision=bf16"

TIMEOUT = 300  # seconds, enough for a busy machine

CHEAP = ["training.gradient_checkpointing=true", "training.frozen_precision=bf16", "training.ema_device=cpu", BF16]


def sharded_state(run: Path) -> dict[str, torch.Tensor]:
    """The training state of a run's newest checkpoint, put together from the parts of all processes."""
    folder = max(run.glob("step-*")) / "training"
    return read_shards(folder, lambda _, shape, dtype: torch.empty(shape, dtype=dtype))


def saved_model(run: Path) -> dict[str, torch.Tensor]:
    """All weights of a run's newest checkpoint by file and name."""
    files = sorted(max(run.glob("step-*")).glob("model/**/*.safetensors"))
    return {f"{path.name} {name}": tensor for path in files for name, tensor in read_tensors(path)[0].items()}


def largest_difference(one: dict[str, torch.Tensor], two: dict[str, torch.Tensor]) -> float:
    """The largest difference between weights of the same names."""
    assert one.keys() == two.keys()
    return max(float((one[name].float() - two[name].float()).abs().max()) for name in one if one[name].numel())


def arguments_in(folder: Path, walks: Path, codec: Path, stage1: Path) -> Callable[..., list[str]]:
    """What makes the arguments of a training of either stage whose run lies in ``folder``."""

    def of(number: str, name: str, *changes: str) -> list[str]:
        base = f"base={codec if number == 'stage1' else stage1}"
        return stage(number, walks, folder / name, base, BATCH, f"training.clip={CLIP}", *changes)

    return of


def train_by_one(of: Callable[..., list[str]]) -> None:
    """Train both stages by one process, as ``one-1`` and ``one-2``."""
    run_persist(*of("stage1", "one-1"))
    run_persist(*of("stage2-voxel", "one-2"))


@pytest.fixture(scope="module")
def runs(walks, codec, stage1, tmp_path_factory):
    """Runs of one process and of two, some of them resumed by one process and by two in turn."""
    folder = tmp_path_factory.mktemp("pair")
    of = arguments_in(folder, walks, codec, stage1)
    train_by_one(of)
    low_rank = [f"base={stage1}", "lora.rank=2"]
    run_persist(*of("stage1", "one-lora", *low_rank))
    run_persist(*of("stage2-voxel", "one-few", FEW))
    run_persist(*of("stage2-voxel", "one-own", *OWN))
    distil = [f"base={stage1}", "distill.levels=6", "training.ema=0.99"]
    run_persist(*of("stage1", "one-distilled", *distil))
    against = [f"base={stage1}", "adversarial.width=8"]
    run_persist(*of("stage1", "one-against", *against))
    first = [job(*of("stage1", f"{kind}-1"), **how) for kind, how in KINDS.items()]
    first += [job(*of("stage2-voxel", f"{kind}-2", "training.accumulation=2"), **how) for kind, how in KINDS.items()]
    for kind in KINDS:
        run_persist(*of("stage1", f"{kind}-parts", "training.steps=1"))
    later = ("--resume", "training.steps=3")
    first += [job(*of("stage1", f"{kind}-parts", *later), **how) for kind, how in KINDS.items()]
    first.append(job(*of("stage1", "fsdp-first", "training.steps=1"), **FSDP))
    first.append(job(*of("stage1", "fsdp-lora", *low_rank), **FSDP))
    cached = [FEW, "--cache", str(folder / "cache")]
    first += [job(*of("stage2-voxel", f"{name}-few", *cached)) for name in ("cold", "warm")]
    first.append(job(*of("stage2-voxel", "ddp-own", *OWN)))
    first.append(job(*of("stage1", "ddp-distilled", *distil, "training.accumulation=2")))
    first.append(job(*of("stage1", "ddp-against", *against)))
    wrong = job(*stage("codec", walks, folder / "codec", *MICRO_SETTINGS), **FSDP)
    ended = run_in_two(folder, *first, job(*of("stage2-voxel", "fsdp-own", *OWN), **FSDP), wrong)
    assert [code for code, _ in ended[:-2]] == [0] * len(first), ended
    (folder / "own.txt").write_text(ended[-2][1])
    for kind in KINDS:
        run_persist(*of("stage1", f"{kind}-parts", "--resume"))
    run_persist(*of("stage2-voxel", "one-warm", *cached))
    (folder / "wrong.txt").write_text(f"{ended[-1][0]} {ended[-1][1]}")
    return folder


@pytest.fixture(scope="module")
def savings(runs, walks, codec, stage1):
    """The runs, with those of two processes that save memory or compute in bf16."""
    of = arguments_in(runs, walks, codec, stage1)
    jobs = [job(*of("stage1", f"{kind}-bf16", BF16), **how) for kind, how in KINDS.items()]
    jobs += [job(*of("stage2-voxel", f"{kind}-cheap", *CHEAP), **how) for kind, how in KINDS.items()]
    jobs.append(job(*of("stage1", "fsdp-offloaded", BF16), **FSDP, FSDP_OFFLOAD_PARAMS="true"))
    assert [code for code, _ in run_in_two(runs, *jobs)] == [0] * len(jobs)
    return runs


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("number", [1, 2])
def test_two_processes_train_to_the_losses_and_weights_of_one(runs, kind, number):
    """In stage 2 each process also adds up two micro-batches."""
    one, two = runs / f"one-{number}", runs / f"{kind}-{number}"
    assert losses(two) == pytest.approx(losses(one), rel=1e-5)
    assert largest_difference(saved_model(one), saved_model(two)) < NEAR


def test_two_processes_write_their_own_predictions_as_one_does(runs):
    assert losses(runs / "ddp-own") == pytest.approx(losses(runs / "one-own"), rel=1e-4)


def test_two_processes_train_against_a_discriminator_as_one_does(runs):
    assert losses(runs / "ddp-against") == pytest.approx(losses(runs / "one-against"), rel=1e-4)
    assert largest_difference(saved_model(runs / "one-against"), saved_model(runs / "ddp-against")) < NEAR


def test_two_processes_distil_as_one_does(runs):
    assert losses(runs / "ddp-distilled") == pytest.approx(losses(runs / "one-distilled"), rel=1e-4)
    assert largest_difference(saved_model(runs / "one-distilled"), saved_model(runs / "ddp-distilled")) < NEAR


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_resumed_by_other_numbers_of_processes_ends_like_that_of_one(runs, kind):
    assert losses(runs / f"{kind}-parts") == pytest.approx(losses(runs / "one-1"), rel=1e-5)
    one, parts = (run_result(runs / name)[0] for name in ("one-1", f"{kind}-parts"))
    assert torch.equal(one.pop("random/torch"), parts.pop("random/torch"))
    assert largest_difference(one, parts) < NEAR
    assert largest_difference(saved_model(runs / "one-1"), saved_model(runs / f"{kind}-parts")) < NEAR


def test_a_sharded_checkpoint_has_a_file_for_each_process_and_no_pickle(runs):
    step = max((runs / "fsdp-1").glob("step-*"))
    sizes = [path.stat().st_size for path in sorted((step / "training").glob("*.safetensors"))]
    assert max(sizes) < 0.6 * sum(sizes)
    kinds = {path.suffix for path in step.rglob("*") if path.is_file()}
    assert kinds == {".safetensors", ".json", ".yaml", ""}  # the last of SHA256SUMS
    assert sharded_state(runs / "fsdp-1").keys() == run_result(runs / "one-1")[0].keys()


def test_sharded_gradients_are_clipped_by_the_norm_of_all_of_them(runs):
    assert first_gradients(sharded_state(runs / "fsdp-first")).norm() == pytest.approx(CLIP, rel=1e-3)


def test_a_sharded_run_saves_a_whole_model(runs):
    backbone = load_backbone(find_checkpoint(runs / "fsdp-1"))
    assert not any(parameter.is_meta for parameter in backbone.parameters())


@pytest.mark.parametrize(
    ("policy", "classes", "sharded"),
    [
        (None, None, ["CogVideoXBlock", "MemoryBlock"]),
        ("TRANSFORMER_BASED_WRAP", None, ["CogVideoXBlock", "MemoryBlock"]),  # as of `accelerate config`
        ("TRANSFORMER_BASED_WRAP", "CogVideoXBlock", ["CogVideoXBlock"]),
        ("NO_WRAP", None, None),
    ],
)
def test_blocks_are_sharded_one_by_one_unless_the_launcher_names_others(monkeypatch, policy, classes, sharded):
    chosen = {"FSDP_AUTO_WRAP_POLICY": policy, "FSDP_TRANSFORMER_CLS_TO_WRAP": classes}
    loading = {"FSDP_CPU_RAM_EFFICIENT_LOADING": "true"}  # as of the launcher; the plugin changes it
    for name, value in (FSDP | loading | {name: value for name, value in chosen.items() if value}).items():
        monkeypatch.setenv(name, value)
    plugin, backbone = fsdp_plugin("no"), with_adapter(micro())
    backbone.trained_parameters("2")
    process = SimpleNamespace(device=torch.device("cpu"), state=SimpleNamespace(fsdp_plugin=plugin))
    Sharding(backbone, make_recipe(read_recipe("tiny-stage2-voxel"), "the recipe"), process)
    assert plugin.transformer_cls_names_to_wrap == sharded


@pytest.mark.slow
def test_sharded_training_in_bf16_is_like_that_with_ddp(savings):
    exact, ddp, fsdp = (losses(savings / name) for name in ("one-1", "ddp-bf16", "fsdp-bf16"))
    assert ddp == pytest.approx(exact, rel=1e-2)
    assert fsdp == pytest.approx(ddp, rel=2e-3)
    weights = saved_model(savings / "fsdp-bf16")
    assert losses(savings / "fsdp-offloaded") == fsdp
    assert largest_difference(saved_model(savings / "fsdp-offloaded"), weights) == 0
    assert {weight.dtype for weight in weights.values()} == {torch.float32}


@pytest.mark.slow
def test_memory_savings_train_nearly_alike_sharded_and_not(savings):
    """Gradient checkpointing, frozen weights in bf16 and averages on the CPU at once."""
    assert losses(savings / "ddp-cheap") == pytest.approx(losses(savings / "one-2"), rel=1e-2)
    assert losses(savings / "fsdp-cheap") == pytest.approx(losses(savings / "ddp-cheap"), rel=2e-3)


def test_lora_trains_sharded_as_in_one_process(runs):
    assert losses(runs / "fsdp-lora") == pytest.approx(losses(runs / "one-lora"), rel=1e-5)
    one, sharded = (saved_model(runs / name) for name in ("one-lora", "fsdp-lora"))
    assert any("lora_B" in name for name in one)
    assert largest_difference(one, sharded) < NEAR


def test_processes_share_a_cache_that_one_alone_can_use_too(runs):
    for name in ("cold-few", "warm-few", "one-warm"):
        assert losses(runs / name) == pytest.approx(losses(runs / "one-few"), rel=1e-5)
    assert equal_runs(runs / "cold-few", runs / "warm-few")
    assert [share_cached(runs / name) for name in ("warm-few", "one-warm")] == [1, 1]
    assert share_cached(runs / "cold-few") < 1


def test_a_missing_or_damaged_part_of_a_checkpoint_ends_in_one_line(persist, walks, codec, runs, tmp_path):
    run = shutil.copytree(runs / "fsdp-first", tmp_path / "run")
    arguments = stage("stage1", walks, run, f"base={codec}", BATCH, f"training.clip={CLIP}", "--resume")
    part = min(next(run.glob("step-*")).glob("training/*.safetensors"))
    content = part.read_bytes()
    part.write_bytes(content[:-1] + b"\1")
    ended = persist(*arguments)
    assert (ended.code, f"{part}: damaged or changed" in ended.err) == (1, True), ended.err
    without_sums(next(run.glob("step-*")))  # as in earlier versions
    for damaged, cause in (
        (content[:-9], "its parts cannot be read"),
        (b"", "its parts cannot be read"),
        (None, "missing"),
    ):
        part.unlink()
        if damaged is not None:
            part.write_bytes(damaged)
        ended = persist(*arguments)
        assert (ended.code, cause in ended.err, len(ended.err.strip().splitlines())) == (1, True, 1), ended.err


def test_each_training_that_cannot_be_sharded_ends_in_one_line(persist, walks, codec, runs, tmp_path, monkeypatch):
    message = (runs / "wrong.txt").read_text()
    assert message.startswith("1 ")
    assert "stage codec trains codec, which is not sharded" in message
    assert "data.own_writes needs the whole model in each process; launch with" in (runs / "own.txt").read_text()
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert (ended.code, "add --fsdp_version 2" in ended.err) == (1, True)


def test_shards_by_size_are_refused_in_one_line(persist, walks, codec, tmp_path, monkeypatch):
    for name, value in (FSDP | {"FSDP_AUTO_WRAP_POLICY": "SIZE_BASED_WRAP"}).items():
        monkeypatch.setenv(name, value)
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert (ended.code, "SIZE_BASED_WRAP: FSDP2 does not shard the lists" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1


class EndlessRun:
    """A run of two processes that only a signal ends."""

    def __init__(self, run: Path, arguments: list[str], kind: tuple[str, ...]) -> None:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
        self.run, self.launcher = (
            run,
            subprocess.Popen(**two_process_launch("persist_cli", *arguments, kind=kind), **pipes),
        )
        self.processes: list[int] = []

    def wait(self) -> None:
        """Wait for its first checkpoint."""
        deadline = time.monotonic() + TIMEOUT
        while not list(self.run.glob("step-*")) and time.monotonic() < deadline and self.launcher.poll() is None:
            time.sleep(0.05)
        children = Path(f"/proc/{self.launcher.pid}/task/{self.launcher.pid}/children").read_text().split()
        self.processes = [int(child) for child in children]
        assert len(self.processes) == 2, self.end()

    def end(self) -> tuple[int, str]:
        """Wait for its end; returns the launcher's exit code and all output."""
        output, _ = self.launcher.communicate(timeout=TIMEOUT)
        return self.launcher.returncode, output

    def kill(self) -> None:
        """End all of its processes."""
        for process in self.processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self.launcher.kill()
        self.launcher.wait()


@pytest.fixture
def endless(walks, codec, tmp_path):
    """Arguments of the run ``run``, which has no end of its own."""
    changes = [f"base={codec}", "training.steps=100000", "training.checkpoint_every=2"]
    return stage("stage1", walks, tmp_path / "run", *changes)


@pytest.fixture
def start(endless, tmp_path):
    """Starts the run ``run`` with options of the launcher and returns it after its first checkpoint."""
    runs = []

    def of(*kind: str) -> EndlessRun:
        runs.append(EndlessRun(tmp_path / "run", endless, kind))
        runs[-1].wait()
        return runs[-1]

    yield of
    for run in runs:
        run.kill()


@pytest.fixture
def resume(persist, walks, codec, tmp_path):
    """Takes two more steps from the run's checkpoint with one process."""

    def of() -> None:
        run = tmp_path / "run"
        step = int(find_checkpoint(run).folder.parent.name.removeprefix("step-"))
        ended = persist(*stage("stage1", walks, run, "--resume", f"base={codec}", f"training.steps={step + 2}"))
        assert ended.code == 0, ended.err
        assert len(losses(run)) == step + 2
        assert not list(run.glob(".partial-*"))

    return of


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_a_killed_process_ends_the_run_with_one_line_and_a_checkpoint_to_resume(start, resume, killed):
    run = start("--use_fsdp", "--fsdp_version", "2")
    os.kill(run.processes[killed], signal.SIGKILL)
    code, output = run.end()
    lines = [line for line in output.splitlines() if line.startswith("error: ")]
    assert (code, len(lines)) == (1, 1), output
    assert re.search(rf"process {1 - killed} of 2 lost another one.*step-\d+ is whole, go on with --resume", lines[0])
    assert re.search(rf"rank +: {killed} .*\n.*exitcode +: -9", output)  # the launcher's table
    resume()


def test_sigterm_to_one_process_saves_on_all(endless, resume, tmp_path):
    pair = start_pair(run_command, endless, output=tmp_path, environment=FSDP)
    wait_until(lambda: list((tmp_path / "run").glob("step-*")), pair[0])
    pair[1].send(signal.SIGTERM)
    codes, output = [process.wait() for process in pair], "".join(map(Path.read_text, tmp_path.glob("*.log")))
    assert codes == [143, 143], output
    assert output.count("go on with --resume") == 1, output
    resume()


@pytest.mark.slow
def test_sigterm_to_the_launcher_saves_on_all(start, resume):
    """The launcher, which may be the first to get the signal, always ends with 1."""
    run = start("--use_fsdp", "--fsdp_version", "2")
    os.kill(run.launcher.pid, signal.SIGTERM)
    exit_code, output = run.end()
    assert exit_code == 1, output
    assert output.count("go on with --resume") == 1, output
    resume()


@pytest.mark.slow
def test_ctrl_c_saves_on_all(start, resume):
    run = start("--multi_gpu")
    os.killpg(run.launcher.pid, signal.SIGINT)  # as a terminal does
    _, output = run.end()
    assert output.count("go on with --resume") == 1, output
    resume()


def make_in_pair(homes: list[Path], run: Path) -> None:
    """Make a run's backbone of this process's own twins, and write its prompt or why there is none into its home."""
    home = homes[PartialState(cpu=True).process_index]
    os.chdir(home)
    for twin in ("twin", "without"):
        settings = {"pretrained": twin, "frames": 17, "height": 32, "width": 48, "prompt": "a walk"}
        recipe = make_recipe({"stage": "1", "backbone": {"name": "cogvideox", "settings": settings}}, "mine")
        try:
            outcome = str(start_backbone(with_computed_settings(recipe, run), None).prompt)
        except PersistError as error:
            outcome = str(error)
        (home / f"{twin}.txt").write_text(outcome)


def test_the_main_process_alone_embeds_the_prompt(tmp_path):
    homes = [tmp_path / "main", tmp_path / "other"]
    whole = write_text_encoder(write_twin("2b", homes[0] / "twin"))
    for twin in (homes[0] / "without", homes[1] / "twin", homes[1] / "without"):
        shutil.copytree(whole, twin, ignore=shutil.ignore_patterns("text_encoder"))
    assert run_in_pair(make_in_pair, homes, tmp_path, output=tmp_path) == [0, 0]
    made, refused = ([(home / f"{twin}.txt").read_text() for home in homes] for twin in ("twin", "without"))
    assert made == 2 * [str(load_twin(whole, prompt="a walk").prompt)]
    assert refused[0] == refused[1]
    assert "no text_encoder/ to embed the prompt" in refused[0]
