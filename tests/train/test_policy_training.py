"""Training runs of policies, which are those of backbones in all but their samples."""

from __future__ import annotations

import json
import shutil

import pytest
from accelerate import Accelerator

from persist_cli.api.checkpoint import step_folders
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors
from persist_cli.policies.trained import find_policy
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.train.policy_trainer import PolicyTrainer
from persist_cli.train.training_loop import learning_rate
from tests.support.damage import without_sums
from tests.support.micro_policies import MICRO_POLICY, micro_network, policy_stage
from tests.support.micro_runs import equal_runs, losses, run_result


@pytest.fixture(scope="module")
def whole(walks, tmp_path_factory, request):
    from tests.support.micro_runs import run_persist

    run = tmp_path_factory.mktemp("policies") / "whole"
    run_persist(*policy_stage(walks, run, "training.checkpoint_every=2", "training.keep_checkpoints=9"))
    return run


def test_a_run_leaves_recipe_log_curve_and_a_policy_with_its_scenes(whole):
    assert {"recipe.yaml", "log.jsonl", "loss.png", "speed.jsonl"} < {path.name for path in whole.iterdir()}
    model = whole / "step-00000004/model"
    assert {path.name for path in model.iterdir()} == {"model.safetensors", "policy.json", "recipe.yaml", "SHA256SUMS"}
    card = json.loads((model / "policy.json").read_text())
    assert (card["policy"], card["training_scenes"]["names"]) == ("nomad", [["room-0", "room-1"]])
    row = json.loads((whole / "log.jsonl").read_text().splitlines()[0])
    assert {"loss", "noise_error", "distance_error", "learning_rate"} <= set(row)


def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(persist, walks, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "halves")
    shutil.rmtree(tmp_path / "halves/step-00000004")
    changes = ("training.checkpoint_every=2", "training.keep_checkpoints=9", "--resume")
    assert persist(*policy_stage(walks, tmp_path / "halves", *changes)).code == 0
    assert equal_runs(whole, tmp_path / "halves")
    weights = [read_tensors(run / "step-00000004/model/model.safetensors")[0] for run in (whole, tmp_path / "halves")]
    assert all(weights[0][name].equal(weights[1][name]) for name in weights[0])


def test_a_run_begins_at_the_weights_of_its_base(persist, walks, whole, tmp_path):
    still = ["training.steps=1", "training.learning_rate=1e-12", "training.ema=0", f"base={whole}"]
    assert persist(*policy_stage(walks, tmp_path / "run", *still)).code == 0
    average = read_tensors(whole / "step-00000004/model/model.safetensors")[0]
    begun = run_result(tmp_path / "run")[0]
    assert all(begun[f"parameter/{name}"].allclose(value, atol=1e-9) for name, value in average.items())
    assert len(losses(tmp_path / "run")) == 1


def test_a_run_knows_the_scenes_of_its_base_too_after_it_was_resumed_without_that(persist, held_out, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "base")
    on = policy_stage(held_out, tmp_path / "run", f"base={tmp_path / 'base'}", "training.keep_checkpoints=9")
    assert persist(*on, "training.steps=1").code == 0
    shutil.rmtree(tmp_path / "base")
    ended = persist(*on, "training.steps=2", "--resume")
    assert ended.code == 0, ended.err
    scenes = [find_policy(step).training_scenes for step in step_folders(tmp_path / "run")]
    assert scenes == [TrainingScenes(frozenset(["room-0", "room-1", "held-out-0", "held-out-1"]))] * 2


def test_a_run_on_a_base_of_unknown_scenes_does_not_know_all_of_its_own(persist, walks, whole, tmp_path):
    base = tmp_path / "base"
    shutil.copytree(whole / "step-00000004/model", base)
    card = json.loads((base / "policy.json").read_text())
    del card["training_scenes"]
    (without_sums(base) / "policy.json").write_text(json.dumps(card))
    assert persist(*policy_stage(walks, tmp_path / "run", f"base={base}", "training.steps=1")).code == 0
    assert find_policy(tmp_path / "run").training_scenes == TrainingScenes(frozenset(["room-0", "room-1"]), False)


def test_samples_are_those_of_the_seed_the_mirror_and_the_detour_of_the_recipe(walks):
    values = {
        "stage": "policy",
        "policy": {"name": "nomad", "settings": MICRO_POLICY},
        "data": {"path": str(walks), "mirror": 0.25, "detour": 1.5},
        "training": {"seed": 5},
    }
    samples = PolicyTrainer(
        make_recipe(values, "mine"), micro_network(), TrainingScenes(), Accelerator(cpu=True)
    ).dataset
    assert (samples.seed, samples.mirror, samples.detour) == (5, 0.25, 1.5)
    assert samples.form == micro_network().sample_form


def test_the_learning_rate_may_follow_a_cosine():
    settings = make_recipe(read_recipe("houses-64-policy"), "houses-64-policy").training
    half = settings.warmup + (settings.steps - settings.warmup) // 2
    assert learning_rate(settings, half) == pytest.approx(settings.learning_rate / 2)
    assert learning_rate(settings, settings.steps - 1) < 1e-3 * settings.learning_rate


def test_a_dry_run_counts_the_parts_of_the_policy(persist):
    record = json.loads(persist("finetune", "nomad-policy", "--dry-run", "--json").out)
    assert (record["policy"], record["total"]["parameters"]) == ("nomad", 15_697_915)
    assert record["total"]["trained"] == {"policy": 15_697_915}
    assert "noise" in persist("finetune", "houses-64-policy", "--dry-run").out


def test_the_weights_of_the_small_policy_are_below_10_megabytes_in_half_precision(persist):
    record = json.loads(persist("finetune", "houses-64-policy", "--dry-run", "--json").out)
    assert 2 * record["total"]["parameters"] < 10_000_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("policy.name=random", "policy 'random' has no network to train"),
        ("policy.settings.token=8", "did you mean 'tokens'"),
        ("data.own_writes=0.5", "stage policy takes no data.own_writes; leave them out"),
        ("data.detour=0.5", "data.detour must be a number of at least 1"),
        ("training.compile=true", "stage policy takes no training.compile"),
        ("stage=1", "stage policy needs policy"),
        ("base=runs/nothing", "runs/nothing: no trained policy there"),
    ],
)
def test_what_means_nothing_to_a_policy_is_refused_before_anything_is_written(
    persist, walks, tmp_path, change, message
):
    ended = persist(*policy_stage(walks, tmp_path / "run", change))
    assert ended.code == 1
    assert message in ended.err
    assert len(ended.err.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_a_policy_has_no_cache_and_a_recipe_of_it_no_plan_of_memory(persist, walks, tmp_path):
    ended = persist(*policy_stage(walks, tmp_path / "run", "--cache", str(tmp_path / "cache")))
    assert (ended.code, "leave it out" in ended.err) == (1, True)
    assert persist("doctor", "houses-64-policy").code == 1


def test_a_card_that_was_changed_is_refused_before_the_weights_are_read(policy_run, tmp_path):
    folder = shutil.copytree(find_policy(policy_run).folder, tmp_path / "policy")
    card = folder / "policy.json"
    card.write_text(card.read_text().replace('"fingerprint": "', '"fingerprint": "0'))
    with pytest.raises(CheckpointError, match=r"policy\.json"):
        find_policy(folder)
