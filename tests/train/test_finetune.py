"""Training runs: their files, their numbers, and how they stop, resume and fail."""

from __future__ import annotations

import errno
import json
import random
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.io.files import read_tensors
from persist_cli.io.signals import STOPPING
from persist_cli.train.log import StepLog
from persist_cli.train.trainer import Trainer
from tests.support.damage import without_sums
from tests.support.disk import file_limit
from tests.support.micro_runs import (
    MICRO_SETTINGS,
    SHORT,
    equal_runs,
    first_gradients,
    losses,
    run_persist,
    run_result,
    stage,
)
from tests.support.processes import ForkedProcess, run_in_a_session, start_persist, wait_until


def test_a_run_writes_its_recipe_logs_loss_curve_and_checkpoint(codec):
    names = {"recipe.yaml", "log.jsonl", "loss.png", "speed.jsonl", "data.json", "step-00000004"}
    assert {path.name for path in codec.iterdir()} - {"used-by"} == names
    assert json.loads((codec / "speed.jsonl").read_text())["samples_per_second"] > 0
    rows = [json.loads(line) for line in (codec / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4]
    assert rows[0]["learning_rate"] < rows[-1]["learning_rate"]


def test_the_loss_curve_is_a_picture_and_there_is_none_before_the_first_step(draw_loss, codec, tmp_path):
    log = StepLog(Path(shutil.copy(codec / "log.jsonl", tmp_path)), 4)
    draw_loss(log, tmp_path / "loss.png")
    picture = np.asarray(Image.open(tmp_path / "loss.png"))
    assert picture.shape == (480, 840, 4)
    assert picture.std() > 0
    draw_loss(StepLog(tmp_path / "empty.jsonl", 0), tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


@pytest.mark.parametrize("number", ["codec", "stage1", "stage2-voxel"])
def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(walks, codec, stage1, voxel, tmp_path, number):
    whole = {"codec": codec, "stage1": stage1, "stage2-voxel": voxel}[number]
    base = {"codec": MICRO_SETTINGS, "stage1": [f"base={codec}"], "stage2-voxel": [f"base={stage1}"]}[number]
    run_persist(*stage(number, walks, tmp_path / "halves", *base, "training.steps=1"))
    run_persist(*stage(number, walks, tmp_path / "halves", "--resume", *base, "training.steps=2"))
    run_persist(*stage(number, walks, tmp_path / "halves", "--resume", *base))
    assert equal_runs(whole, tmp_path / "halves")


def test_a_run_resumes_that_a_version_without_one_of_the_settings_began(persist, walks, codec, tmp_path):
    assert persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.steps=1")).code == 0
    recipe = tmp_path / "run/recipe.yaml"
    recipe.write_text(recipe.read_text().replace("  clips_per_trajectory: 0\n", ""))
    assert persist(*stage("stage1", walks, tmp_path / "run", "--resume", f"base={codec}")).code == 0


def test_stage_2_leaves_the_weights_of_stage_1_unchanged_to_the_bit(persist, walks, stage1, tmp_path):
    before = find_checkpoint(stage1).fingerprint
    assert persist(*stage("stage2-voxel", walks, tmp_path / "voxel", f"base={stage1}")).code == 0
    assert all(name.split("/")[-1].startswith(("adapters.", "torch")) for name in run_result(tmp_path / "voxel")[0])
    assert find_checkpoint(tmp_path / "voxel").fingerprint == before
    assert find_checkpoint(stage1).fingerprint == before


@pytest.mark.parametrize("weighting", ["uniform", "min-snr"])
@pytest.mark.parametrize("parts", [2, 4])
def test_micro_batches_train_like_the_whole_batch(persist, walks, codec, tmp_path, weighting, parts):
    base = [f"base={codec}", "training.batch=4", f"backbone.settings.weighting={weighting}", "training.steps=2"]
    assert persist(*stage("stage1", walks, tmp_path / "one", *base)).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "two", *base, f"training.accumulation={parts}")).code == 0
    assert losses(tmp_path / "one") == pytest.approx(losses(tmp_path / "two"), rel=1e-4)
    one, two = (run_result(tmp_path / name)[0] for name in ("one", "two"))
    moments = [name for name in one if "exp_avg/" in name]
    assert all(torch.allclose(one[name], two[name], rtol=1e-3, atol=1e-6) for name in moments)
    differences = [(one[name] - two[name]).flatten() for name in one if name.startswith("parameter/")]
    assert torch.cat(differences).abs().mean() < 1e-2 * 4e-4  # a hundredth of a step


def test_micro_batches_are_those_of_the_recipe_whatever_the_environment_of_accelerate_says(
    walks, codec, stage1, tmp_path, monkeypatch
):
    monkeypatch.setenv("ACCELERATE_GRADIENT_ACCUMULATION_STEPS", "4")
    run_persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert equal_runs(stage1, tmp_path / "run")


def test_gradients_are_clipped_by_the_norm_of_all_of_them(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", "training.steps=1", "training.clip=0.001"]
    assert persist(*stage("stage1", walks, tmp_path / "run", *changes)).code == 0
    assert first_gradients(run_result(tmp_path / "run")[0]).norm() == pytest.approx(0.001, rel=1e-3)


def test_a_gradient_that_is_not_finite_ends_a_run_before_it_changes_a_weight(
    persist, walks, codec, tmp_path, monkeypatch
):
    prepare, trained = Trainer.prepare, list[torch.nn.Parameter]()

    def prepare_with_a_fault(trainer, model, parameters, opponent=None):
        trained.extend(parameters.values())
        for parameter in trained:
            parameter.register_hook(lambda gradient: gradient * float("inf"))
        prepare(trainer, model, parameters, opponent)

    monkeypatch.setattr(Trainer, "prepare", prepare_with_a_fault)
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
    assert "the norm of the gradients is nan at step 0; lower training.learning_rate" in ended.err
    assert all(parameter.isfinite().all() for parameter in trained)


def test_training_lowers_the_loss(persist, walks, codec, tmp_path):
    changes = ["training.steps=40", "training.learning_rate=3e-3", "training.batch=4", f"base={codec}"]
    assert persist(*stage("stage1", walks, tmp_path / "run", *changes)).code == 0
    values = losses(tmp_path / "run")
    assert sum(values[-10:]) < 0.9 * sum(values[:10])


def test_the_saved_weights_are_the_moving_average_of_those_after_each_step(persist, walks, codec, tmp_path):
    states = []
    for changes in (["training.steps=1"], ["training.steps=2", "--resume"]):
        assert persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", *changes)).code == 0
        states.append(run_result(tmp_path / "run")[0])
    model = max((tmp_path / "run").glob("step-*")) / "model/transformer/diffusion_pytorch_model.safetensors"
    weight = 2 ** (-2 / 3)  # of the new parameters in the second step of diffusers' warm-up
    for name, saved in read_tensors(model)[0].items():
        first, second = (state[f"parameter/transformer.base.{name}"] for state in states)
        assert torch.allclose(saved, first + weight * (second - first), atol=1e-7)
    assert not torch.equal(first, second)


SIX = ["training.checkpoint_every=1", "training.steps=6"]


@pytest.fixture(scope="module")
def uninterrupted(walks, codec, tmp_path_factory):
    run = tmp_path_factory.mktemp("whole") / "run"
    run_persist(*stage("stage1", walks, run, f"base={codec}", *SIX))
    return run


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_run_killed_at_a_random_moment_resumes_and_ends_like_an_uninterrupted_one(
    persist, uninterrupted, walks, codec, tmp_path, seed
):
    run = tmp_path / "killed"
    arguments = stage("stage1", walks, run, "--resume", f"base={codec}", *SIX)
    child = start_persist(*arguments)
    wait_until(lambda: list(run.glob("step-*")), child)
    time.sleep(random.Random(seed).random() * 0.3)
    child.send(signal.SIGKILL)
    child.wait()
    find_checkpoint(run)
    assert persist(*arguments).code == 0
    assert equal_runs(run, uninterrupted)
    assert not list(run.glob(".partial-*"))


def test_each_step_is_saved_once_and_has_a_speed(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", "training.checkpoint_minutes=0", "training.steps=3"]
    assert persist(*stage("stage1", walks, tmp_path / "run", *changes)).code == 0
    rows = [json.loads(line) for line in (tmp_path / "run/speed.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3]
    assert all(row["samples_per_second"] > 0 for row in rows)


@pytest.mark.parametrize("step", [3, 5])
def test_a_signal_right_after_the_check_for_signals_loses_no_step(persist, walks, codec, tmp_path, monkeypatch, step):
    check = Trainer.agreed

    def check_before_the_signal(trainer, *arguments):
        agreed = check(trainer, *arguments)
        if trainer.state.step == step:
            signal.raise_signal(signal.SIGTERM)
        return agreed

    monkeypatch.setattr(Trainer, "agreed", check_before_the_signal)
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.steps=5"))
    code, message = {3: (143, "stopped at step 4 of 5"), 5: (0, "trained 5 steps")}[step]
    assert (ended.code, message in ended.out) == (code, True)
    assert saved_steps(tmp_path / "run") == [min(step + 1, 5)]


def test_a_disk_that_is_full_at_the_picture_of_the_loss_is_told_as_that(persist, walks, codec, tmp_path, monkeypatch):
    def draw(_log, path):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(StepLog, "draw", draw)
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.steps=1"))
    assert ended.code == 1
    assert "loss.png: No space left on device; make room there" in ended.err
    assert saved_steps(tmp_path / "run") == [1]  # whole, so that the run goes on


def test_a_full_disk_ends_a_run_with_one_line_and_leaves_the_last_checkpoint(persist, walks, codec, tmp_path):
    changes = ["--resume", f"base={codec}"]
    assert persist(*stage("stage1", walks, tmp_path / "run", *changes, "training.steps=1")).code == 0
    with file_limit(20_000):
        ended = persist(*stage("stage1", walks, tmp_path / "run", *changes))
    assert (ended.code, "a checkpoint cannot be written there" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1
    assert [path.name for path in (tmp_path / "run").glob("*step*")] == ["step-00000001"]


def test_a_log_that_cannot_be_rewritten_stays_as_it_was(tmp_path):
    lines = "".join(json.dumps({"step": step, "loss": 0.5}) + "\n" for step in range(1, 1001))
    (tmp_path / "log.jsonl").write_text(lines)
    with file_limit(5_000), pytest.raises(OSError, match="too large"):
        StepLog(tmp_path / "log.jsonl", 900)
    assert (tmp_path / "log.jsonl").read_text() == lines


def test_several_data_sets_train_like_a_single_one_with_all_trajectories(persist, walks, codec, tmp_path):
    for number in (0, 1):
        (tmp_path / str(number)).mkdir()
        shutil.copy(walks / f"walk-{number}.parquet", tmp_path / str(number))
    changes = [f"base={codec}", "training.steps=2"]
    assert persist(*stage("stage1", walks, tmp_path / "one", *changes)).code == 0
    assert persist(*stage("stage1", tmp_path / "0", tmp_path / "two", "--data", tmp_path / "1", *changes)).code == 0
    assert equal_runs(tmp_path / "one", tmp_path / "two")


def test_a_run_trains_on_the_bundled_sample_data(persist, walks, codec, tmp_path, monkeypatch):
    shutil.copytree(walks, tmp_path / "home/sample")
    monkeypatch.setenv("PERSIST_REFERENCE", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    ended = persist(*stage("stage1", "sample", "run", f"base={codec}", "training.steps=1"))
    assert ended.code == 0, ended.err


@pytest.mark.parametrize("sent", STOPPING)
def test_ctrl_c_and_preemption_save_a_checkpoint_and_say_how_to_resume(walks, codec, tmp_path, sent):
    changes = ["training.steps=100000", "training.workers=1"]
    arguments = stage("stage1", walks, tmp_path / "run", f"base={codec}", *changes)
    child = ForkedProcess(run_in_a_session, arguments, output=tmp_path / "printed")
    log = tmp_path / "run/log.jsonl"
    wait_until(lambda: log.is_file() and log.stat().st_size, child)
    child.send_to_group(sent)  # its process that reads data gets it too, as from a terminal or a scheduler
    assert child.wait() == 128 + sent
    assert "go on with --resume" in (tmp_path / "printed").read_text()
    find_checkpoint(tmp_path / "run")


def test_each_impossible_run_ends_in_one_line(persist, walks, codec, stage1, tmp_path):
    base = f"base={codec}"
    for arguments, cause in (
        (stage("stage1", walks, codec), "holds a run already"),
        (
            stage(
                "codec",
                walks,
                codec,
                "--resume",
                *MICRO_SETTINGS,
                "training.learning_rate=1",
                "chosen_on=8 houses",
                "description=another",
            ),
            "another recipe; training.learning_rate changed",
        ),
        (stage("stage1", walks, tmp_path / "a", f"base={tmp_path}"), "no checkpoint there"),
        (stage("stage1", walks, tmp_path / "a", "base=zai-org/CogVideoX-2b"), "backbone.settings.pretrained=zai-org/"),
        (stage("stage1", tmp_path, tmp_path / "a", base), "no trajectory"),
        (
            stage("stage2-voxel", walks, tmp_path / "a", f"base={stage1}", "memory.encoder=patchs"),
            "did you mean 'patches'",
        ),
        (stage("stage2-voxel", walks, tmp_path / "a", f"base={stage1}", "adapter.widht=3"), "did you mean 'width'"),
        (stage("stage1", walks, tmp_path / "a", base, "backbone.name=cogvideo"), "is of backbone 'cogvideox'"),
    ):
        ended = persist(*arguments)
        assert ended.code == 1
        assert cause in ended.err
        assert len(ended.err.strip().splitlines()) == 1
    assert not list((tmp_path / "a").glob("step-*"))


@pytest.mark.parametrize("workers", [0, 1])
def test_images_that_are_damaged_end_a_run_in_one_line_whichever_process_reads_them(
    persist, walks, codec, tmp_path, workers
):
    shutil.copytree(walks, tmp_path / "walks")
    for path in (tmp_path / "walks").iterdir():
        content = path.read_bytes()
        path.write_bytes(content[:1000] + bytes(len(content) // 2) + content[1000 + len(content) // 2 :])
    changes = [f"base={codec}", f"training.workers={workers}"]
    ended = persist(*stage("stage1", tmp_path / "walks", tmp_path / "run", *changes))
    assert (ended.code, "not a whole Parquet file" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1


def test_a_damaged_checkpoint_or_another_base_ends_a_rollout_in_one_line(persist, walks, codec, tmp_path):
    run = tmp_path / "base"
    short = [f"base={codec}", "training.steps=1"]
    assert persist(*stage("stage1", walks, run, *short)).code == 0
    assert persist(*stage("stage2-none", walks, tmp_path / "none", f"base={run}", "training.steps=1")).code == 0
    shutil.rmtree(run)
    assert persist(*stage("stage1", walks, run, *short, "training.seed=1")).code == 0
    ended = persist("rollout", tmp_path / "none", "--start", f"{walks}#0", "--follow", "--out", tmp_path / "o")
    assert (ended.code, "another base" in ended.err) == (1, True)
    model = next(run.glob("step-*")) / "model"
    (model / "world.safetensors").write_bytes(b"0" * 20)
    ended = persist("rollout", run, "--start", f"{walks}#0", "--follow", "--out", tmp_path / "o")
    assert (ended.code, "world.safetensors" in ended.err) == (1, True)
    (without_sums(model) / "persist.json").write_text("{}")
    ended = persist("rollout", run, "--start", f"{walks}#0", "--follow", "--out", tmp_path / "o")
    assert (ended.code, "not the card of a persist checkpoint" in ended.err) == (1, True)


def saved_steps(run):
    return [int(path.name.removeprefix("step-")) for path in sorted(run.glob("step-*"))]


def test_a_run_keeps_as_many_of_its_newest_checkpoints_as_the_recipe_says(persist, walks, codec, tmp_path):
    every = stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.checkpoint_every=1")
    ended = persist(*every, "training.steps=3", "training.keep_checkpoints=2")
    assert (ended.code, saved_steps(tmp_path / "run")) == (0, [2, 3])
    assert "2 checkpoints kept: step 2, step 3\n" in ended.out
    ended = persist(*every, "training.steps=4", "--resume")
    assert "2 checkpoints kept: step 3 (ended its recipe), step 4\n" in ended.out
    assert saved_steps(tmp_path / "run") == [3, 4]
    ended = persist(*every, "training.keep_checkpoints=0", "--resume")
    assert (ended.code, "training.keep_checkpoints" in ended.err) == (1, True)


def test_a_run_that_is_resumed_for_the_steps_it_has_taken_ends_its_recipe_there(persist, walks, codec, tmp_path):
    run = tmp_path / "run"
    twice = stage("stage1", walks, run, f"base={codec}", "training.checkpoint_every=1", "training.keep_checkpoints=2")
    assert persist(*twice, "training.steps=2").code == 0
    shutil.rmtree(run / "step-00000002")  # as if it had been stopped at step 1
    assert "1 checkpoint kept: step 1\n" in persist(*twice, "training.steps=1", "--resume").out
    assert persist(*twice, "training.steps=3", "training.keep_checkpoints=1", "--resume").code == 0
    assert saved_steps(run) == [1, 3]


@pytest.fixture(scope="module")
def extended(walks, codec, tmp_path_factory):
    """A stage-1 run ``base`` that trained on after ``voxel`` had taken a step on a checkpoint in the middle of it."""
    folder = tmp_path_factory.mktemp("extended")
    base = stage("stage1", walks, folder / "base", f"base={codec}", "training.checkpoint_every=1")
    run_persist(*base, "training.steps=2", "training.keep_checkpoints=2")
    middle = f"base={folder / 'base/step-00000001'}"
    run_persist(*stage("stage2-voxel", walks, folder / "voxel", middle, "training.steps=1"))
    run_persist(*base, "training.steps=3", "--resume")
    return folder


def test_a_stage_2_run_keeps_the_checkpoint_that_it_stands_on_when_its_base_trains_on(persist, walks, extended):
    assert saved_steps(extended / "base") == [1, 2, 3]
    card = json.loads((find_checkpoint(extended / "voxel").folder / "persist.json").read_text())
    assert card["base"] == "../../../base/step-00000001/model"
    start = ["--start", f"{walks}#0", "--actions", "left", "--steps", 1]
    ended = persist("rollout", extended / "voxel", *start, "--out", extended / "o")
    assert ended.code == 0, ended.err


def test_a_resumed_stage_2_run_goes_on_with_the_step_of_its_base_that_it_began_on(persist, walks, extended, tmp_path):
    middle = f"base={extended / 'base/step-00000001'}"
    assert persist(*stage("stage2-voxel", walks, tmp_path / "whole", middle, "training.steps=2")).code == 0
    shutil.copytree(extended / "voxel", extended / "halves")
    newest = f"base={extended / 'base'}"
    ended = persist(*stage("stage2-voxel", walks, extended / "halves", newest, "training.steps=2", "--resume"))
    assert ended.code == 0, ended.err
    assert equal_runs(tmp_path / "whole", extended / "halves")


def test_a_resumed_stage_1_run_goes_on_with_the_codec_that_it_began_on(persist, walks, codec, tmp_path):
    shutil.copytree(codec, tmp_path / "codec")
    one = stage("stage1", walks, tmp_path / "one", f"base={tmp_path / 'codec'}")
    assert persist(*one, "training.steps=1").code == 0
    longer = stage("codec", walks, tmp_path / "codec", *MICRO_SETTINGS, "training.steps=5", "--resume")
    assert persist(*longer).code == 0
    assert persist(*one, "training.steps=2", "--resume").code == 0
    assert persist(*stage("stage1", walks, tmp_path / "whole", f"base={codec}", "training.steps=2")).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "one")


def test_a_start_that_fails_leaves_no_mark_in_the_base(persist, walks, extended, tmp_path):
    base = f"base={extended / 'base'}"
    assert persist(*stage("stage2-voxel", walks, tmp_path / "a", base, "adapter.widht=3")).code == 1
    assert not list((extended / "base/used-by").glob("*.a-*"))


def test_a_finished_run_says_where_it_is_and_the_next_command(persist, walks, extended, codec):
    again = stage("stage1", walks, extended / "base", f"base={codec}", "training.checkpoint_every=1")
    ended = persist(*again, "training.steps=3", "--resume")
    assert f"checkpoint in {extended / 'base'}\n" in ended.out
    assert f"next: persist finetune tiny-stage2-voxel --data {walks} base={extended / 'base'}\n" in ended.out


@pytest.fixture
def trained_on(persist, walks, stage1, voxel, tmp_path) -> Path:
    """A run whose adapter is that of another run, trained on for a step that changes next to nothing."""
    run = tmp_path / "on"
    (tmp_path / "recipe.yaml").write_text(f"stage: '2'\nbase: {stage1}\nadapter_from: {voxel}\n")
    small = ["training.steps=1", "training.learning_rate=1e-12", "training.ema=0", "training.precision=no"]
    arguments = ["finetune", tmp_path / "recipe.yaml", "--data", walks, "--out", run, *SHORT, *small]
    result = persist(*arguments)
    assert result.code == 0, result.err
    return run


def test_an_adapter_can_be_trained_on_with_its_own_memory_and_settings(trained_on, voxel):
    before, after = (find_checkpoint(run).adapter_folder("voxel") for run in (voxel, trained_on))
    tensors, others = (read_tensors(folder / "adapter.safetensors")[0] for folder in (before, after))
    assert all(torch.allclose(tensors[name], others[name], atol=1e-6) for name in tensors)
    for name in ("memory.json", "adapter.json"):
        assert (before / name).read_text() == (after / name).read_text()


def test_a_recipe_with_settings_of_its_own_for_an_adapter_that_is_trained_on_is_refused(persist, walks, voxel):
    result = persist(*stage("stage2-voxel", walks, "out", f"base={voxel}", f"adapter_from={voxel}"))
    assert result.code == 1
    assert "memory and settings come with that adapter; leave out" in result.err


@pytest.mark.parametrize(
    ("memory", "cause"),
    [
        ("voxel", "memory must be a mapping, or null, not 'voxel'"),
        ("{settings: [1]}", "memory.settings must be a mapp"),
    ],
)
def test_a_memory_that_is_no_mapping_is_refused_with_an_adapter_too(persist, walks, voxel, stage1, memory, cause):
    changes = (f"base={stage1}", f"adapter_from={voxel}", "adapter={}", f"memory={memory}")
    result = persist(*stage("stage2-voxel", walks, "out", *changes))
    assert (result.code, cause in result.err) == (1, True), result.err
