"""Plans of memory for models of scenes, and what they count."""

from __future__ import annotations

import json

from tests.support.micro_scenes import MICRO_SCENE

MICRO = [f"scene.settings.{name}={json.dumps(value)}" for name, value in MICRO_SCENE.items()]


def plan(persist, *arguments):
    ended = persist("doctor", *arguments, "--json")
    assert ended.code == 0, ended.err
    return json.loads(ended.out)


def test_a_dry_run_counts_the_parts_of_a_model_of_scenes_and_what_each_stage_trains(persist):
    record = json.loads(persist("finetune", "houses-64-scene", "--dry-run", "--json").out)
    trained = record["total"]["trained"]
    assert (record["scene"], sum(trained.values())) == ("scene", record["total"]["parameters"])
    assert [part["name"] for part in record["parts"]] == ["codec", "given", "view", "action", "transformer", "outcomes"]
    assert 2 * record["total"]["parameters"] < 15_000_000  # bytes in half precision


def test_more_samples_at_once_need_more_activations_and_no_more_weights(persist):
    few, many = (plan(persist, "tiny-scene", *MICRO, f"training.batch={batch}") for batch in (2, 8))
    few, many = few["strategies"][0]["need"], many["strategies"][0]["need"]
    assert few["weights"] == many["weights"]
    assert 3 < many["activations"] / few["activations"] < 5


def test_the_codec_needs_moments_for_its_own_parameters_alone(persist):
    recipes = {"scene-codec": "tiny-scene-codec", "scene": "tiny-scene", "scene-outcome": "houses-64-scene-outcome"}
    record = json.loads(persist("finetune", "tiny-scene", *MICRO, "--dry-run", "--json").out)["total"]["trained"]
    for stage, name in recipes.items():
        need = plan(persist, name, *MICRO)["strategies"][0]["need"]
        assert need["optimizer"] == 8 * record[stage]


def test_the_model_of_persists_size_is_planned_as_the_page_of_sizes_says(persist):
    record = plan(persist, "scene-persist-size", "training.accumulation=64")
    count, trained = record["total"]["parameters"], record["total"]["trained"]["scene"]
    need = record["strategies"][0]["need"]
    assert round(count / 1e6) == 322
    assert round(need["peak"] / 2**30) == 8
    assert 4 * count <= need["weights"] < 4.001 * count
    assert need["optimizer"] == 8 * trained
    assert need["activations"] > need["weights"]  # of a single sample


def test_a_model_of_scenes_is_not_sharded(persist):
    ended = persist("doctor", "tiny-scene", "--gpus", "2", "--gpu-memory", "24", "--fsdp")
    assert (ended.code, "a model of scenes is not sharded" in ended.err) == (1, True)
