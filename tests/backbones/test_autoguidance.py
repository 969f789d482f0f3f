"""Sampling away from a weaker version of the model: where it acts, what it changes, and what it leaves alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.model import WorldTransformer
from persist_cli.api.backbone import Sampling
from persist_cli.errors import CheckpointError, PersistError
from tests.support.micro_model import equal, micro, random_clips, random_tokens, shaken, trained
from tests.support.micro_runs import MICRO

THREE = Sampling(4, autoguidance=3.0)


def model_and_guide(folder: Path) -> CogVideoX:
    """A model with an adapter that knows where its guide is, whose video model has other weights."""
    model = trained()
    model.save_base(folder)
    guide = micro()
    guide.load_base(folder)
    shaken(guide.transformer, 0.02)
    guide.save_base(folder)
    model.guide_folder = folder
    return model


def predictions(
    model: CogVideoX, sampling: Sampling, monkeypatch: pytest.MonkeyPatch
) -> list[tuple[str, float, Tensor]]:
    """Who predicted what at which timestep while a clip was sampled; ``guided`` is what the sampler took."""
    seen: list[tuple[str, float, Tensor]] = []
    run, guided = WorldTransformer.predict, type(model).predict_guided

    def predict(transformer: WorldTransformer, *inputs: Any) -> Tensor:
        made = run(transformer, *inputs)
        name = "model" if transformer is model.transformer else "guide"
        seen.append((name, float(inputs[2].timestep[0]), made))
        return made

    def predict_guided(owner: CogVideoX, *inputs: Any) -> Tensor:
        made = guided(owner, *inputs)
        seen.append(("guided", float(inputs[2].timestep[0]), made))
        return made

    monkeypatch.setattr(WorldTransformer, "predict", predict)
    monkeypatch.setattr(type(model), "predict_guided", predict_guided)
    model.generate(random_clips(1), sampling)
    return seen


def test_it_goes_beyond_the_guide_at_the_noisier_half_of_the_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = predictions(model_and_guide(tmp_path), THREE, monkeypatch)
    by_level: dict[float, dict[str, Tensor]] = {}
    for name, timestep, made in seen:
        by_level.setdefault(timestep, {})[name] = made
    assert len(by_level) == 4
    for timestep, made in by_level.items():
        if timestep >= 500:
            torch.testing.assert_close(made["guided"], made["guide"] + 3 * (made["model"] - made["guide"]))
            assert not torch.equal(made["guided"], made["model"])
        else:
            assert set(made) == {"model", "guided"}
            assert torch.equal(made["guided"], made["model"])
    assert {timestep >= 500 for timestep in by_level} == {True, False}


def test_a_guide_that_is_the_model_itself_changes_nothing(tmp_path: Path) -> None:
    model = micro()
    shaken(model)
    model.save_base(tmp_path)
    model.guide_folder = tmp_path
    with_guide, without = (model.sample(random_clips(), Sampling(4, autoguidance=weight)) for weight in (2.0, 1.0))
    torch.testing.assert_close(with_guide, without)


def test_the_guide_is_no_part_of_the_model_and_is_told_the_memory(tmp_path: Path) -> None:
    model = model_and_guide(tmp_path)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    clips = random_clips(1), random_clips(1, random_tokens(1, 5))
    alone, remembering = (model.generate(clip, THREE)[0] for clip in clips)
    assert not torch.equal(alone, remembering)
    assert before.keys() == model.state_dict().keys()
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    plain = model.generate(clips[0], Sampling(4))
    assert equal(plain, model.generate(clips[0], Sampling(4)))
    assert not torch.equal(plain[0], alone)


def test_weights_of_half_precision_have_a_guide_of_half_precision(tmp_path: Path) -> None:
    model = model_and_guide(tmp_path)
    model.generate(random_clips(1), THREE)
    model.to(torch.bfloat16)
    rgb, _ = model.generate(random_clips(1), THREE)
    assert {value.dtype for value in model.guides[0].parameters()} == {torch.bfloat16}  # type: ignore[index]
    assert len(rgb.unique()) > 2


@pytest.mark.parametrize(
    ("weight", "cause"), [(0.5, "at least 1"), (float("nan"), "at least 1"), (2.0, "has no guide")]
)
def test_a_weight_that_means_nothing_here_is_one_line(weight: float, cause: str) -> None:
    with pytest.raises(PersistError, match=cause):
        micro().check_sampling(Sampling(2, autoguidance=weight))


def test_a_guide_of_other_sizes_is_one_line(tmp_path: Path) -> None:
    model = trained()
    micro(transformer=MICRO["transformer"] | {"num_layers": 3}).save_base(tmp_path)
    model.guide_folder = tmp_path
    with pytest.raises(CheckpointError, match="guide's transformer has another"):
        model.generate(random_clips(1), THREE)
