"""The reduced twin of each published model, saved by diffusers alone and loaded as our backbone."""

import dataclasses

import pytest
import torch
from diffusers import (
    AutoencoderKLCogVideoX,
    CogVideoXDDIMScheduler,
    CogVideoXImageToVideoPipeline,
    CogVideoXPipeline,
    CogVideoXTransformer3DModel,
)

from persist_backbones.cogvideox.diffusion import noise_like, sample_generators
from persist_backbones.cogvideox.inputs import ClipShape, middle_region, rotary_grid, rotary_positions
from persist_backbones.pipeline.pipeline import WorldPipeline
from persist_cli.api.backbone import Sampling
from persist_cli.errors import CheckpointError
from persist_cli.plugins import make_backbone
from tests.support.micro_model import equal, random_clips, random_tokens, shaken, with_adapter
from tests.support.misaligned import misalign, misaligned
from tests.support.published_configs import TRANSFORMERS
from tests.support.twins import NAMES, SIZE, SMALL, load_twin, write_twin

SHORTER = (9, 32, 32)  # frames, height and width, unlike those in the configurations
NAMES_AND_SIZES = [(name, size) for name in NAMES for size in (SIZE, SHORTER)]
NAMES_AND_SIZES.remove(("5b-i2v", SHORTER))  # diffusers takes a learned table for images of its own size only
every_model = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    home = tmp_path_factory.mktemp("twins")
    return {name: write_twin(name, home / name) for name in NAMES}


def plain_pipeline(folder, name):
    """Make diffusers' own pipeline of a directory, without text encoder."""
    transformer = CogVideoXTransformer3DModel.from_pretrained(folder / "transformer")
    vae = AutoencoderKLCogVideoX.from_pretrained(folder / "vae")
    scheduler = CogVideoXDDIMScheduler.from_pretrained(folder / "scheduler")
    kind = CogVideoXImageToVideoPipeline if "i2v" in name else CogVideoXPipeline
    pipe = kind(None, None, vae, transformer, scheduler)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def transformer_inputs(model, run):
    """Collect all input channels of each call of the transformer while ``run`` runs."""
    latents = []
    hook = model.transformer.register_forward_pre_hook(lambda _, inputs: latents.append(inputs[0].detach()))
    run()
    hook.remove()
    return latents


@torch.no_grad()
@every_model
def test_the_widened_twin_predicts_what_diffusers_does_to_the_bit(twins, name):
    model, pipe, clips = load_twin(twins[name]), plain_pipeline(twins[name], name), random_clips(2, size=SIZE)
    torch.manual_seed(0)
    noisy, image = torch.randn(2, 2, model.shape.padded_frames, 8, 8, 12)
    image = image if "i2v" in name else torch.zeros_like(image)
    conditions = dataclasses.replace(model.conditions(clips, torch.tensor([3, 700])), text=torch.randn(2, 10, 8))
    ours = model.predict(noisy, image, conditions)
    config = pipe.transformer.config
    rotary, offset = None, noisy.new_full((1,), 2.0) if config.ofs_embed_dim else None
    if config.use_rotary_positional_embeddings:
        rotary = pipe._prepare_rotary_positional_embeddings(*SIZE[1:], noisy.shape[1], torch.device("cpu"))
    inputs = torch.cat([noisy[:, :, :4], image[:, :, :4]], dim=2)[:, :, : config.in_channels]
    text, timestep = conditions.text, conditions.timestep
    expected = pipe.transformer(inputs, text, timestep, ofs=offset, image_rotary_emb=rotary).sample
    assert torch.equal(ours[:, :, :4], expected)
    assert not ours[:, :, 4:].any()


@torch.no_grad()
@pytest.mark.parametrize(("name", "size"), NAMES_AND_SIZES)
def test_an_untrained_twin_generates_what_diffusers_own_pipeline_does(twins, name, size):
    model, pipe, clips = load_twin(twins[name], size), plain_pipeline(twins[name], name), random_clips(1, size=size)
    rgb, _ = model.generate(clips, Sampling(steps=4))
    noise = noise_like(model.encode_first(clips), sample_generators(clips.seeds))[:, :, :4]
    image = {"image": clips.rgb[:, 0].permute(0, 3, 1, 2) / 255} if "i2v" in name else {}
    frames, height, width = size
    video = pipe(
        **image, prompt_embeds=torch.zeros(1, 10, 8), latents=noise, num_inference_steps=4, guidance_scale=1.0,
        num_frames=frames, height=height, width=width, output_type="pt",
    ).frames  # fmt: skip
    expected = (video.permute(0, 1, 3, 4, 2) * 255).round()
    assert rgb.shape == expected.shape
    assert (rgb[:, 1:] - expected[:, 1:]).abs().max() <= 1


@every_model
def test_our_own_pipeline_generates_what_the_backbone_does(twins, name):
    model, clips = load_twin(twins[name], SHORTER), random_clips(1, size=SHORTER)
    pipeline = WorldPipeline.of(model)
    pipeline.set_progress_bar_config(disable=True)
    output = pipeline(
        clips.rgb[0, 0].numpy(), clips.depth[0, 0], clips.cameras, num_inference_steps=2, output_type="pt",
        generator=sample_generators(clips.seeds),
    )  # fmt: skip
    rgb, depth = model.generate(clips, Sampling(2))
    assert torch.equal((output.frames.movedim(2, -1) * 255).round().to(torch.uint8), rgb)
    assert torch.equal(output.depth, depth)


@torch.no_grad()
@every_model
def test_training_and_sampling_scale_the_image_latents_as_diffusers_does(twins, name):
    model, clips = load_twin(twins[name]), random_clips(1, size=SIZE)
    trained, sampled = (transformer_inputs(model, run)[0][:, :, 4:8] for run in (
        lambda: model(clips, "1"), lambda: model.generate(clips, Sampling(steps=1)),
    ))  # fmt: skip
    first = clips.rgb[:, :1].permute(0, 4, 1, 2, 3) / 127.5 - 1
    latents = model.codec.vae.encode(first).latent_dist.mode().transpose(1, 2)
    scale = model.codec.vae.config.scaling_factor
    assert torch.equal(trained, sampled)
    assert torch.allclose(trained[:, :1], latents / scale if name.startswith("1.5") else latents * scale, atol=1e-5)
    assert not trained[:, 1:].any()


@every_model
def test_every_stage_of_a_twin_has_a_finite_loss_and_gradients_everywhere(twins, name):
    model = with_adapter(load_twin(twins[name], SHORTER))
    shaken(model)
    model.prompt.normal_(generator=torch.Generator().manual_seed(0))
    picked = [(*("pick_up", "drop", "toggle") * 2, "pick_up", "drop")]
    clips = random_clips(1, random_tokens(1, 12), picked, SHORTER)
    for stage in ("codec", "1", "2"):
        parameters = model.trained_parameters(stage)
        loss = model(clips, stage)["loss"]
        gradients = torch.autograd.grad(loss, list(parameters.values()))
        pairs = zip(parameters, gradients, strict=True)
        assert torch.isfinite(loss)
        assert [name for name, gradient in pairs if not gradient.any()] == []


@every_model
def test_a_trained_twin_survives_saving_and_diffusers_reads_its_own_parts(twins, name, tmp_path):
    model, clips = load_twin(twins[name], SHORTER), random_clips(1, size=SHORTER)
    shaken(model, 0.02)
    model.save_base(tmp_path)
    loaded = make_backbone("cogvideox", model.checkpoint_settings()).eval()
    loaded.load_base(tmp_path)
    assert equal(model.generate(clips, Sampling(2)), loaded.generate(clips, Sampling(2)))
    pipe = plain_pipeline(tmp_path, name)
    for part, plain_part in ((model.transformer.base, pipe.transformer), (model.codec.vae, pipe.vae)):
        weights, plain_weights = part.state_dict(), plain_part.state_dict()
        assert weights.keys() == plain_weights.keys()
        assert all(torch.equal(value, plain_weights[key]) for key, value in weights.items())
    assert pipe.scheduler.config.snr_shift_scale == (3.0 if name == "2b" else 1.0)


@pytest.mark.parametrize("form", ["cross", "projected", "canvas", "rendered"])
def test_weights_are_loaded_into_memory_that_torch_allocated_wherever_they_lie_in_their_files(twins, form, tmp_path):
    model = with_adapter(load_twin(twins["5b-i2v"], SHORTER), form=form)
    for folder in ("base", "adapter"):
        (tmp_path / folder).mkdir()
    model.save_base(tmp_path / "base")
    model.save_adapter(tmp_path / "adapter")
    WorldPipeline.of(model).save_pretrained(tmp_path / "pipeline")
    for path in tmp_path.rglob("*.safetensors"):
        misalign(path)
    with torch.device("meta"):
        loaded = make_backbone("cogvideox", model.checkpoint_settings())
    loaded.load_base(tmp_path / "base")
    loaded.load_adapter("memory", tmp_path / "adapter")
    pipeline = WorldPipeline.from_pretrained(tmp_path / "pipeline")
    assert misaligned(loaded) == misaligned(pipeline.backbone) == []
    clips = random_clips(1, size=SHORTER)
    for backbone in (loaded.eval(), pipeline.backbone):
        assert equal(model.generate(clips, Sampling(2)), backbone.generate(clips, Sampling(2)))


@pytest.mark.parametrize("form", ["cross", "projected", "canvas", "rendered"])
def test_in_version_1_5_a_memory_reaches_the_tokens_of_the_frames_that_see_it(twins, form):
    model = with_adapter(
        load_twin(twins["1.5-5b-i2v"], SHORTER), form=form, **({"head_width": 8} if form == "canvas" else {})
    )
    clips = random_clips(1, size=SHORTER)
    clips.cameras.world_from_camera[:, 5:, 0, 0] = clips.cameras.world_from_camera[:, 5:, 2, 2] = -1  # look back
    ahead, behind = random_tokens(1, 1), random_tokens(1, 1)
    ahead.positions[:] = torch.tensor([0.0, 0.0, 5.0])
    behind.positions[:] = torch.tensor([0.0, 0.0, -1.0])
    memories = [model.memory_condition(dataclasses.replace(clips, tokens=tokens)) for tokens in (ahead, behind)]
    masks = [memory.memory.mask for memory in memories]
    if form != "cross":  # tokens of the padding and the first frame, and of the eight others
        visible = [mask.reshape(1, 2, -1).any(dim=-1).tolist() for mask in masks]
        assert visible == [[[True, True]], [[False, True]]]
    fresh = model.generate(clips, Sampling(1))
    shaken(model.adapter)
    changed = model.generate(dataclasses.replace(clips, tokens=ahead), Sampling(1))
    assert torch.isfinite(changed[1]).all()
    assert not torch.equal(fresh[0], changed[0])


@pytest.mark.parametrize(("frames", "multiple"), [(3, 2), (4, 2), (5, 3), (5, 1)])
def test_dropping_the_padding_gives_the_latents_back(frames, multiple):
    shape, latents = ClipShape(frames, 2, 2, 2, multiple), torch.randn(1, frames, 4, 2, 2)
    padded = shape.pad(latents)
    assert padded.shape[1] % multiple == 0
    assert torch.equal(shape.drop_padding(padded), latents)
    assert all(torch.equal(frame, latents[:, 0]) for frame in padded.unbind(1)[: shape.padded_frames - frames])


@torch.no_grad()
def test_a_learned_table_is_cut_to_the_clip_and_its_middle_resampled(twins):
    model = load_twin(twins["5b-i2v"], SHORTER)
    table = CogVideoXTransformer3DModel.from_pretrained(twins["5b-i2v"] / "transformer").patch_embed.pos_embedding
    resampled = model.transformer.base.patch_embed.pos_embedding
    video = table[0, 10:].unflatten(0, (5, 4, 6))[:3, :, 1:5]
    assert torch.equal(resampled[0, :10], table[0, :10])
    assert torch.equal(resampled[0, 10:], video.flatten(0, 2))
    assert model.transformer.base.config.sample_frames == 9
    with pytest.raises(CheckpointError, match="learned positions are for clips of 17 frames at most; ask for fewer"):
        load_twin(twins["5b-i2v"], (25, 32, 48))


@torch.no_grad()
def test_rotary_positions_at_another_size_are_those_of_diffusers_for_the_middle_of_the_trained_grid(twins, tmp_path):
    model = load_twin(twins["5b-i2v"], SHORTER)
    pipe = plain_pipeline(twins["5b-i2v"], "5b-i2v")
    expected = pipe._prepare_rotary_positional_embeddings(*SHORTER[1:], 3, torch.device("cpu"))
    model.save_base(tmp_path)
    loaded = make_backbone("cogvideox", model.checkpoint_settings())
    loaded.load_base(tmp_path)
    assert middle_region((32, 32), (30, 45)) == ((0, 8), (30, 38))  # 512x512 in the grid of 480x720
    for twin in (model, loaded):
        assert equal(twin.conditions(random_clips(1, size=SHORTER), torch.tensor([3])).rotary, expected)


def test_rotary_positions_of_a_wide_image_are_those_of_diffusers(twins):
    pipe = plain_pipeline(twins["5b"], "5b")
    config, height, width, frames = pipe.transformer.config, 32, 64, 4
    expected = pipe._prepare_rotary_positional_embeddings(height, width, frames, torch.device("cpu"))
    unit = pipe.vae_scale_factor_spatial * config.patch_size
    grid = (frames, height // unit, width // unit)
    assert equal(rotary_positions(config, grid, rotary_grid(config), torch.device("cpu")), expected)


@pytest.mark.parametrize(("frames", "token_frames"), [(3, 1), (3, 2)])
@pytest.mark.parametrize("known", [1, 3])
def test_the_given_frame_is_the_first_of_the_image_condition_and_views_of_it_are_the_last(frames, token_frames, known):
    shape = ClipShape(frames, 1, 1, patch=1, token_frames=token_frames)
    latents = torch.arange(1.0, 1 + known)[None, :, None, None, None]
    padding = [0.0] * (shape.padded_frames - known)
    assert shape.image_condition(latents).flatten().tolist() == [1.0, *padding, *[2.0, 3.0][: known - 1]]


@every_model
def test_a_twin_differs_from_the_published_model_only_in_its_sizes(twins, name):
    config = load_twin(twins[name]).transformer.base.config
    sizes = {*SMALL, "in_channels", "out_channels", "ofs_embed_dim"}
    assert {key for key, value in TRANSFORMERS[name].items() if config[key] != value} <= sizes


def test_a_saved_pipeline_does_not_contain_the_path_of_its_pretrained_weights(twins, tmp_path):
    WorldPipeline.of(load_twin(twins["2b"])).save_pretrained(tmp_path)
    assert str(twins["2b"]) not in (tmp_path / "world" / "config.json").read_text()
    assert WorldPipeline.from_pretrained(tmp_path).backbone.shape == load_twin(twins["2b"]).shape
