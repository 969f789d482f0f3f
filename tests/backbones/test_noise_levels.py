"""Noise with a level on the given frame and the memory: the model is told the level, and old models stay the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from persist_backbones.cogvideox.diffusion import noise_like, sample_generators
from persist_backbones.noise_levels import add_level, draw_levels, fill_with_noise
from persist_cli.api.backbone import Clips, Sampling
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.tokens import MemoryTokens
from persist_cli.checkpoints.load import check_noise, checked_sampling
from persist_cli.errors import PersistError
from tests.support.export_runs import write_adapter, write_base
from tests.support.micro_model import equal, micro, predicted_of, random_clips, random_tokens, shaken, with_adapter

FORMS = ["cross", "projected", "canvas", "rendered"]


def write_noisy(folder: Path, image: float, memory: float) -> Path:
    """A voxel adapter whose memory was noisy in training, on a base whose given frame was."""
    backbone = write_base(folder / "base", image_noise=image)
    return write_adapter(backbone, folder / "base", folder / "voxel", "voxel", noise=memory)


def generators() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in (1, 2)]


def test_each_sample_gets_noise_as_strong_as_its_level() -> None:
    values, levels = torch.zeros(2, 50, 50), torch.tensor([0.0, 0.5])
    noisy = add_level(values, levels, generators(), unit=torch.tensor([1.0, 3.0]))
    assert torch.equal(noisy[0], values[0])
    assert noisy[1].std().item() == pytest.approx(1.5, rel=0.1)


def test_samples_that_share_a_generator_draw_in_their_order_however_many_threads_draw() -> None:
    def drawn(threads: int) -> torch.Tensor:
        noise, (shared, own) = torch.empty(9, 50_000), generators()
        fill_with_noise(noise, [shared] * 4 + [own] + [shared] * 4, threads)
        return noise

    alone = torch.randn(50_000, generator=generators()[1])
    assert torch.equal(drawn(1)[4], alone)
    assert all(torch.equal(drawn(8), drawn(1)) for _ in range(20))


def test_noise_is_drawn_in_float32_and_rounded_to_the_precision_of_the_latents_alone() -> None:
    drawn = torch.stack([torch.randn(3, 5, generator=generator) for generator in generators()])
    for precision in (torch.float32, torch.bfloat16):
        noise = noise_like(torch.zeros(2, 3, 5, dtype=precision), generators())
        assert torch.equal(noise, drawn.to(precision))


def test_the_noise_of_a_memory_and_what_is_drawn_next_do_not_depend_on_longer_ones_in_its_batch() -> None:
    backbone, both = with_adapter(micro(), noise=0.5), random_tokens(2, 40)
    both.mask[0, 5:] = False
    alone = MemoryTokens(both.features[:1, :5], both.positions[:1, :5], both.mask[:1, :5])
    noisy, drawn = [], []
    for batch in (alone, both):
        seeded = generators()[: len(batch.mask)]
        tokens = backbone.adapters["voxel"].noisy(batch, torch.full((len(batch.mask),), 0.3), seeded)
        noisy.append(tokens.features[0, :5])
        drawn.append(torch.rand(1, generator=seeded[0]))
    assert torch.equal(*noisy)
    assert torch.equal(*drawn)


def test_levels_lie_below_the_largest_and_a_sample_draws_its_own() -> None:
    both, one = draw_levels(generators(), 0.7), draw_levels(generators()[1:], 0.7)
    assert 0 < both.min() < both.max() < 0.7
    assert torch.equal(both[1:], one)


def test_a_base_without_levels_becomes_one_with_levels_and_first_predicts_the_same(tmp_path: Path) -> None:
    old, clips = micro(), random_clips()
    shaken(old)
    old.save_base(tmp_path)
    new = micro(image_noise=0.5)
    new.load_base(tmp_path)
    sampling = Sampling(2)
    assert equal(new.generate(clips, sampling), old.generate(clips, sampling))
    assert equal(new.generate(clips, dataclasses.replace(sampling, context_noise=0.3)), old.generate(clips, sampling))


def test_a_trained_model_hears_the_declared_level_and_keeps_it_when_saved(tmp_path: Path) -> None:
    model, clips = micro(image_noise=0.5), random_clips(1)
    shaken(model)
    quiet, noisy = (model.generate(clips, Sampling(2, context_noise=level))[0] for level in (0.0, 0.3))
    assert not torch.equal(quiet, noisy)
    model.save_base(tmp_path)
    loaded = micro(image_noise=0.5)
    loaded.load_base(tmp_path)
    assert torch.equal(loaded.generate(clips, Sampling(2, context_noise=0.3))[0], noisy)


@pytest.mark.parametrize(("image", "memory"), [(0.1, 0.5), (0.5, 0.1)])
def test_given_frame_and_memory_are_told_no_level_above_those_of_their_training(image: float, memory: float) -> None:
    def level_told(module: torch.nn.Module, clips: Clips) -> float:
        told: list[torch.Tensor] = []
        hook = module.register_forward_pre_hook(lambda _, inputs: told.append(inputs[0]))
        model.generate(clips, Sampling(1, context_noise=0.5))
        hook.remove()
        return told[0].item()

    model, clips = with_adapter(micro(image_noise=image), noise=memory), random_clips(1, random_tokens(1, 40))
    assert level_told(model.transformer.image_level, clips) == pytest.approx(image)
    assert level_told(model.adapters["voxel"].level, clips) == pytest.approx(memory)


@pytest.mark.parametrize("form", FORMS)
def test_a_memory_is_told_to_be_noisy_but_an_empty_one_says_nothing(form: str) -> None:
    backbone, clips = with_adapter(micro(), form=form, noise=0.5), random_clips(1)
    tokens = random_tokens(1, 40)
    shaken(backbone)
    level = torch.tensor([0.4])
    with torch.no_grad():
        for held, differs in ((tokens, True), (None, False)):
            seen = dataclasses.replace(clips, tokens=held)
            quiet, noisy = (
                predicted_of(backbone, clips, backbone.memory_condition(seen, level=at)) for at in (None, level)
            )
            assert torch.equal(quiet, noisy) != differs


@pytest.mark.parametrize("form", FORMS)
def test_training_with_noise_on_the_memory_reaches_the_embedding_of_its_level(form: str) -> None:
    backbone, clips = with_adapter(micro(), form=form, noise=0.5), random_clips(2, random_tokens(2, 40))
    shaken(backbone)
    parameters = backbone.trained_parameters("2")
    backbone(clips, "2")["loss"].backward()
    assert parameters["adapters.voxel.level.out.weight"].grad.any()


def levels_told(module: torch.nn.Module) -> list[torch.Tensor]:
    """The levels that an embedding is told from now on, call by call."""
    told: list[torch.Tensor] = []
    module.register_forward_pre_hook(lambda _, inputs: told.append(inputs[0]))
    return told


def test_in_training_a_model_is_told_the_level_of_the_noise_on_the_given_frame() -> None:
    model, clips = micro(image_noise=0.5), random_clips(2)
    told = levels_told(model.transformer.image_level)
    model(clips, "1")
    assert torch.equal(told[0], draw_levels(sample_generators(clips.seeds), 0.5))


@pytest.mark.parametrize("form", FORMS)
def test_in_training_an_adapter_is_told_the_level_of_the_noise_on_its_memory(
    form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, clips = with_adapter(micro(), form=form, noise=0.5), random_clips(2, random_tokens(2, 40))
    adapter = model.adapters["voxel"]
    told, noisy, added = levels_told(adapter.level), adapter.noisy, []

    def recording(tokens: MemoryTokens, level: torch.Tensor, seeded: list[torch.Generator]) -> MemoryTokens:
        added.append(level)
        return noisy(tokens, level, seeded)

    monkeypatch.setattr(adapter, "noisy", recording)
    model(clips, "2")
    assert torch.equal(told[0], added[0])
    assert 0 < added[0].min() < added[0].max() < 0.5


def test_noise_of_level_one_is_as_strong_as_the_features_of_a_memory() -> None:
    adapter, tokens = with_adapter(micro(), noise=1.0).adapters["voxel"], random_tokens(2, 400)
    tokens = dataclasses.replace(tokens, features=tokens.features * torch.tensor([0.1, 5.0])[:, None, None])
    noise = adapter.noisy(tokens, torch.ones(2), generators()).features - tokens.features
    assert noise.std(dim=(1, 2)).tolist() == pytest.approx(tokens.features.std(dim=(1, 2)).tolist(), rel=0.1)


def test_the_given_frame_of_each_training_sample_is_noisy_and_the_target_is_not() -> None:
    inputs, clips = {}, random_clips(2)
    for largest in (0.0, 0.5):
        model = micro(image_noise=largest)
        model.transformer.register_forward_pre_hook(lambda _, args, key=largest: inputs.update({key: args[0]}))
        model(clips, "1")
    given = slice(4, 8)  # colours of the given frame, behind the noisy ones
    assert not torch.equal(inputs[0.5][:, :1, given], inputs[0.0][:, :1, given])
    assert torch.equal(inputs[0.5][:, 1:, given], inputs[0.0][:, 1:, given])


def test_a_level_that_was_never_trained_is_refused(tmp_path: Path) -> None:
    model = find_checkpoint(write_noisy(tmp_path, image=0.1, memory=0.4))
    for level in (0.0, 0.1, 0.4):
        assert checked_sampling(model, SamplingOverrides(context_noise=level)).context_noise == level
    with pytest.raises(PersistError, match=r"^context noise of 0.5: .*/voxel was trained with levels up to 0.4, see"):
        checked_sampling(model, SamplingOverrides(context_noise=0.5))
    base = find_checkpoint(tmp_path / "base")
    with pytest.raises(PersistError, match=r"^context noise of 0.4: .*/base was trained with levels up to 0.1, see"):
        checked_sampling(base, SamplingOverrides(context_noise=0.4))
    check_noise(Sampling(context_noise=0.4), [base, model])  # a row of the base is told no more than it knows
    with pytest.raises(PersistError, match=r"^context noise of -1.0; it must be a number of at least 0$"):
        micro().check_sampling(Sampling(context_noise=-1.0))


@pytest.mark.parametrize("memories", ["stage1,voxel", "voxel"])
def test_an_evaluation_declares_the_noise_that_only_its_memory_knows(persist, held_out, tmp_path, memories):
    model = write_noisy(tmp_path, image=0.0, memory=0.5)
    options = ["--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1, "--steps", 1]
    command = ["eval", model, "--data", held_out, "--memories", memories, *options]
    ended = persist(*command, "--context-noise", 0.3, "--out", tmp_path / "o")
    assert ended.code == 0, ended.err
    ended = persist(*command, "--context-noise", 0.6, "--out", tmp_path / "p")
    assert (ended.code, "context noise of 0.6" in ended.err) == (1, True)
