"""Sampling away from a weaker version of the model: where it acts, what it changes, and what it leaves alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.model import WorldTransformer
from persist_backbones.cogvideox.parts import save_world
from persist_cli.api.backbone import Sampling
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError, PersistError
from tests.support.micro_model import equal, micro, random_clips, random_tokens, shaken, trained
from tests.support.micro_runs import MICRO

THREE = Sampling(4, autoguidance=3.0)


def model_and_guide(folder: Path) -> CogVideoX:
    """A model with an adapter that knows where its guide is, whose video model has other weights."""
    model = trained()
    folder.mkdir(exist_ok=True)
    model.save_base(folder)
    guide = micro()
    guide.load_base(folder)
    shaken(guide.transformer, 0.02)
    guide.save_base(folder)
    model.guide_folder = folder
    return model


def predictions(
    model: CogVideoX, sampling: Sampling, monkeypatch: pytest.MonkeyPatch, tokens: MemoryTokens | None = None
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
    model.generate(random_clips(1, tokens), sampling)
    return seen


def test_it_goes_beyond_the_guide_at_the_noisier_half_of_the_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = predictions(model_and_guide(tmp_path), Sampling(8, autoguidance=3.0), monkeypatch)
    by_level: dict[float, dict[str, Tensor]] = {}
    for name, timestep, made in seen:
        by_level.setdefault(timestep, {})[name] = made
    assert [timestep for timestep in by_level if timestep >= 500] == [999.0, 874.0, 749.0, 624.0]
    assert len(by_level) == 8
    for timestep, made in by_level.items():
        if timestep >= 500:
            torch.testing.assert_close(made["guided"], made["guide"] + 3 * (made["model"] - made["guide"]))
            assert not torch.equal(made["guided"], made["model"])
        else:
            assert set(made) == {"model", "guided"}
            assert torch.equal(made["guided"], made["model"])


def test_it_begins_at_what_guidance_over_memory_comes_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sampling = Sampling(1, memory_guidance=2.0, autoguidance=3.0)
    seen = predictions(model_and_guide(tmp_path), sampling, monkeypatch, random_tokens(1, 5))
    assert [name for name, *_ in seen] == ["model", "model", "guide", "guided"]
    told, without, weaker, guided = (made for *_, made in seen)
    assert not torch.equal(told, without)
    torch.testing.assert_close(guided, weaker + 3 * (without + 2 * (told - without) - weaker))


def test_a_guide_that_is_the_model_itself_changes_nothing(tmp_path: Path) -> None:
    model = micro()
    shaken(model)
    model.save_base(tmp_path)
    model.guide_folder = tmp_path
    with_guide, without = (model.sample(random_clips(), Sampling(4, autoguidance=weight)) for weight in (2.0, 1.0))
    torch.testing.assert_close(with_guide, without)
    assert list(model.guides) == [tmp_path]


def test_the_guide_is_told_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_and_guide(tmp_path)
    guides = []
    for tokens in (None, random_tokens(1, 5)):
        with monkeypatch.context() as patch:
            seen = predictions(model, Sampling(1, autoguidance=3.0), patch, tokens)
        guides += [made for name, _, made in seen if name == "guide"]
    assert len(guides) == 2
    assert not torch.equal(*guides)


def test_the_guide_gets_the_prompt_that_it_was_trained_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_and_guide(tmp_path)
    own = torch.full_like(model.prompt, 2.0)
    save_world(model.transformer, own, tmp_path)
    texts: dict[bool, Tensor] = {}
    run = WorldTransformer.predict

    def predict(transformer: WorldTransformer, *inputs: Any) -> Tensor:
        texts[transformer is model.transformer] = inputs[2].text
        return run(transformer, *inputs)

    monkeypatch.setattr(WorldTransformer, "predict", predict)
    model.generate(random_clips(2), Sampling(1, autoguidance=3.0))
    assert torch.equal(texts[False], own.expand(2, -1, -1))
    assert torch.equal(texts[True], model.prompt.expand(2, -1, -1))


def test_the_guide_is_no_part_of_the_model_and_its_loading_draws_nothing(tmp_path: Path) -> None:
    model, clips = model_and_guide(tmp_path), random_clips(1)
    plain, names = model.generate(clips, Sampling(4)), [*model.state_dict()]
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    assert not torch.equal(model.generate(clips, THREE)[0], plain[0])
    assert torch.equal(torch.rand(3), expected)
    assert [*model.state_dict()] == names
    assert equal(model.generate(clips, Sampling(4)), plain)


def test_another_folder_is_another_guide(tmp_path: Path) -> None:
    model, clips = model_and_guide(tmp_path / "one"), random_clips(1)
    one = model.generate(clips, THREE)
    (tmp_path / "own").mkdir()
    model.save_base(tmp_path / "own")
    model.guide_folder = tmp_path / "own"
    assert not torch.equal(model.generate(clips, THREE)[0], one[0])


def test_weights_of_half_precision_have_a_guide_of_half_precision(tmp_path: Path) -> None:
    model = model_and_guide(tmp_path)
    model.generate(random_clips(1), THREE)
    model.to(torch.bfloat16)
    rgb, _ = model.generate(random_clips(1), THREE)
    assert {value.dtype for value in model.guides[tmp_path].parameters()} == {torch.bfloat16}  # type: ignore[index]
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
