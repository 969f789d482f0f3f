"""The pipeline of diffusers' kind gives its backbone's clips with every feature that diffusers' users expect."""

import functools
from pathlib import Path

import accelerate
import numpy as np
import pytest
import torch
from diffusers import (
    AutoencoderKLCogVideoX,
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    CogVideoXImageToVideoPipeline,
    CogVideoXTransformer3DModel,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    UniPCMultistepScheduler,
)
from PIL import Image

import persist_backbones
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.extensions.inference import enable_tiling
from persist_backbones.pipeline.call_inputs import batch_of_depth, batch_of_images
from persist_backbones.pipeline.pipeline import WorldPipeline, WorldPipelineOutput
from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.tokens import MemoryTokens
from persist_cli.checkpoints.save import save_adapter, save_base
from persist_cli.errors import PersistError
from persist_cli.recipe import MemoryConfig
from tests.support.micro_model import micro, random_clips, random_tokens, shaken, trained

CLIPS = random_clips(2, random_tokens(2, 5))
FORMS = pytest.mark.parametrize("form", ["cross", "projected", "canvas", "rendered"])
FRAMEWISE = {"vae": {"block_out_channels": [8, 8, 8], "norm_num_groups": 4, "latent_channels": 4,
                     "temporal_compression_ratio": 1}}  # fmt: skip


PLAIN = {"memory_tokens": None, "guidance_scale": 1.0}  # for a model without an adapter


def call(pipeline: WorldPipeline, **changes: object) -> WorldPipelineOutput:
    """Call the pipeline on ``CLIPS`` in three steps with guidance."""
    pipeline.set_progress_bar_config(disable=True)
    seeds = [torch.Generator().manual_seed(seed) for seed in CLIPS.seeds]
    options = {"num_inference_steps": 3, "guidance_scale": 1.5, "generator": seeds, "output_type": "pt"}
    options |= {"memory_tokens": CLIPS.tokens, "cameras": CLIPS.cameras} | changes
    return pipeline(CLIPS.rgb[:, 0], CLIPS.depth[:, 0], **options)


def same(one: WorldPipelineOutput, two: WorldPipelineOutput) -> bool:
    """Whether two outputs are equal to the bit."""
    return torch.equal(one.frames, two.frames) and torch.equal(one.depth, two.depth)


@FORMS
def test_a_pipeline_gives_the_clips_of_its_backbone(form):
    backbone = trained(form)
    rgb, depth = backbone.generate(CLIPS, Sampling(3, "ddim", 1.5))
    output = call(WorldPipeline.of(backbone))
    assert torch.equal((output.frames.movedim(2, -1) * 255).round().to(torch.uint8), rgb)
    assert torch.equal(output.depth, depth)


def test_a_pipeline_makes_shorter_clips_where_its_backbone_does():
    backbone = micro(**FRAMEWISE)
    shaken(backbone)
    clips = random_clips(2).shortened(4)
    output = call(WorldPipeline.of(backbone), cameras=clips.cameras, **PLAIN)
    assert torch.equal(output.depth, backbone.generate(clips, Sampling(3))[1])
    assert output.depth.shape[1] == 4


@FORMS
def test_a_saved_pipeline_is_the_same_to_the_bit_and_has_nothing_to_unpickle(form, tmp_path):
    pipeline = WorldPipeline.of(trained(form))
    pipeline.save_pretrained(tmp_path)
    assert same(call(WorldPipeline.from_pretrained(tmp_path)), call(pipeline))
    assert {path.suffix for path in tmp_path.rglob("*") if path.is_file()} == {".json", ".safetensors"}
    with pytest.raises(PersistError, match="weights are saved as safetensors only"):
        pipeline.save_pretrained(tmp_path, safe_serialization=False)


def test_a_pipeline_without_an_adapter_is_stage_1_and_saves_without_one(tmp_path):
    backbone = micro()
    shaken(backbone)
    WorldPipeline.of(backbone).save_pretrained(tmp_path)
    loaded = WorldPipeline.from_pretrained(tmp_path)
    assert loaded.adapter is None
    rgb, _ = backbone.generate(CLIPS, Sampling(3))
    assert torch.equal((call(loaded, **PLAIN).frames.movedim(2, -1) * 255).round().to(torch.uint8), rgb)


@FORMS
def test_in_bfloat16_a_clip_comes_out_near_that_of_float32(form):
    exact = call(WorldPipeline.of(trained(form)))
    coarse = call(WorldPipeline.of(trained(form)).to(torch.bfloat16))
    assert coarse.frames.dtype == torch.float32
    assert 0 < (coarse.frames - exact.frames).abs().mean() < 0.05


def test_weights_of_half_precision_sample_latents_in_float32():
    backbone, taken = trained().to(torch.bfloat16), []
    backbone.sample(CLIPS, Sampling(2, memory_guidance=2.0), lambda step: taken.append(step.latents))
    assert {latents.dtype for latents in taken} == {torch.float32}
    assert all(len(latents.unique()) > len(latents.bfloat16().unique()) for latents in taken)


@pytest.mark.parametrize("settings", [{}, FRAMEWISE], ids=["4 frames a latent", "framewise"])
@FORMS
def test_offloaded_weights_change_no_result(form, settings):
    once = functools.partial(call, num_inference_steps=1)
    exact = once(WorldPipeline.of(trained(form, **settings)))
    whole, layers = (WorldPipeline.of(trained(form, **settings)) for _ in range(2))
    whole.enable_model_cpu_offload(device="cpu")  # with all hooks, but to the same device
    assert same(once(whole), exact)
    assert same(once(whole), exact)
    for part in layers.components.values():
        if isinstance(part, torch.nn.Module):
            accelerate.cpu_offload(part, "cpu")  # like enable_sequential_cpu_offload, which takes no device "cpu"
    assert same(once(layers), exact)
    assert layers.transformer.device.type == layers.vae.device.type == layers.adapter.device.type == "meta"


@pytest.mark.gpu
@pytest.mark.parametrize("offload", ["enable_model_cpu_offload", "enable_sequential_cpu_offload"])
@FORMS
def test_offloaded_weights_sample_on_the_gpu(form, offload):
    exact = call(WorldPipeline.of(trained(form)).to("cuda"))
    pipeline = WorldPipeline.of(trained(form))
    before = torch.cuda.memory_allocated()  # cuBLAS keeps some bytes once it was used
    getattr(pipeline, offload)()
    output = call(pipeline)
    assert output.frames.device.type == "cuda"
    assert torch.allclose(output.frames, exact.frames, atol=1e-3)
    held = torch.cuda.memory_allocated() - before - output.frames.nbytes
    assert held < sum(weight.nbytes for weight in pipeline.transformer.parameters())


def test_slicing_and_tiling_of_the_codec_hardly_change_a_clip():
    exact, sliced, tiled = (WorldPipeline.of(trained()) for _ in range(3))
    sliced.vae.enable_slicing()
    enable_tiling(tiled.vae, 32, 32)
    assert torch.allclose(call(sliced).frames, call(exact).frames, atol=1e-4)
    difference = (call(tiled).frames - call(exact).frames).abs()
    assert 0 < difference.mean() < 0.2  # of random weights; 0.11 measured


def tokens_of(sample: int) -> MemoryTokens:
    """The tokens of one sample of ``CLIPS``."""
    return MemoryTokens(*(getattr(CLIPS.tokens, name)[sample] for name in ("features", "positions", "mask")))


def test_a_sample_does_not_depend_on_its_batch():
    pipeline = WorldPipeline.of(trained())
    whole = call(pipeline)
    alone = pipeline(
        CLIPS.rgb[1, 0], CLIPS.depth[1, 0], CLIPS.cameras[1], memory_tokens=tokens_of(1),
        num_inference_steps=3, guidance_scale=1.5, generator=torch.Generator().manual_seed(1), output_type="pt",
    )  # fmt: skip
    assert torch.allclose(alone.frames[0], whole.frames[1], atol=1e-4)


def test_a_pipeline_takes_lists_of_samples():
    pipeline = WorldPipeline.of(trained())
    whole = call(pipeline)
    listed = pipeline(
        list(CLIPS.rgb[:, 0]), list(CLIPS.depth[:, 0]), [CLIPS.cameras[0], CLIPS.cameras[1]],
        memory_tokens=[tokens_of(0), tokens_of(1)], num_inference_steps=3, guidance_scale=1.5,
        generator=[torch.Generator().manual_seed(seed) for seed in CLIPS.seeds], output_type="pt",
    )  # fmt: skip
    assert same(listed, whole)


def test_a_callback_runs_at_every_step_and_its_changes_take_effect():
    pipeline, steps = WorldPipeline.of(trained()), []

    def watch(pipe, number, timestep, tensors):
        steps.append((number, int(timestep), pipe.num_timesteps, float(tensors["latents"].std()) > 0))
        return {"latents": torch.zeros_like(tensors["latents"])} if number == 2 else tensors

    assert not call(pipeline, callback_on_step_end=watch, output_type="latent").frames.any()
    assert steps == [(0, 999, 3, True), (1, 666, 3, True), (2, 332, 3, True)]
    assert pipeline.current_timestep is None


def test_an_interrupted_call_stops_and_the_next_call_makes_all_steps():
    pipeline, steps = WorldPipeline.of(trained()), []

    def stop(pipe, number, timestep, tensors):
        steps.append(number)
        pipe._interrupt = True
        return tensors

    assert torch.isfinite(call(pipeline, callback_on_step_end=stop).frames).all()
    assert steps == [0]
    assert same(call(pipeline), call(WorldPipeline.of(trained())))


def test_replacing_the_scheduler_changes_the_sampler():
    backbone = trained()
    pipeline = WorldPipeline.of(backbone)
    pipeline.scheduler = CogVideoXDPMScheduler.from_config(pipeline.scheduler.config)
    output, (rgb, _) = call(pipeline), backbone.generate(CLIPS, Sampling(3, "dpm", 1.5))
    assert torch.equal((output.frames.movedim(2, -1) * 255).round().to(torch.uint8), rgb)
    for kind, name in ((UniPCMultistepScheduler, "unipc"), (DPMSolverMultistepScheduler, "dpm++")):
        pipeline.scheduler = kind.from_config(pipeline.scheduler.config)
        output, (rgb, _) = call(pipeline), backbone.generate(CLIPS, Sampling(3, name, 1.5))
        assert torch.equal((output.frames.movedim(2, -1) * 255).round().to(torch.uint8), rgb)
    pipeline.scheduler = EulerDiscreteScheduler()
    with pytest.raises(PersistError, match=r"^scheduler EulerDiscreteScheduler does not keep to training"):
        call(pipeline)


@pytest.mark.parametrize(
    ("make", "cause"),
    [
        (lambda config: CogVideoXDDIMScheduler(prediction_type=config.prediction_type, beta_end=0.02), "not training"),
        (lambda config: UniPCMultistepScheduler(beta_end=0.03), "has not training's noise; make it by from_config"),
        (lambda config: UniPCMultistepScheduler.from_config(config, solver_order=1), "nothing reads solver_order"),
        (lambda config: DPMSolverMultistepScheduler.from_config(config, use_karras_sigmas=True, solver_order=3),
         "nothing reads solver_order, use_karras_sigmas"),
    ],
)  # fmt: skip
def test_a_scheduler_of_other_noise_or_with_options_that_nothing_reads_is_refused(make, cause):
    pipeline = WorldPipeline.of(trained())
    pipeline.scheduler = make(pipeline.scheduler.config)
    with pytest.raises(PersistError, match=cause):
        call(pipeline)


def test_a_pipeline_takes_and_returns_pictures_and_arrays_and_takes_noise():
    pipeline = WorldPipeline.of(trained())
    pipeline.set_progress_bar_config(disable=True)
    picture, path = Image.fromarray(CLIPS.rgb[0, 0].numpy()), CLIPS.cameras[0]
    noise = torch.randn(1, 3, 8, 8, 8)
    from_picture = pipeline(picture, None, path, num_inference_steps=1, latents=noise)
    from_array = pipeline(CLIPS.rgb[:1, 0].movedim(-1, 1) / 255, None, path, num_inference_steps=1, latents=noise,
                          output_type="np", return_dict=False)  # fmt: skip
    assert (from_picture.frames[0][0].size, len(from_picture.frames[0])) == ((32, 32), 9)
    pixels = np.array(from_picture.frames[0][5])
    assert np.abs(from_array[0][0, 5] * 255 - pixels).max() <= 0.51


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"output_type": "gif"}, "^unknown output_type 'gif'; known: pil, np, pt, latent$"),
        ({"num_inference_steps": 0}, "^0 denoising steps; it must be at least 1$"),
        ({"guidance_scale": -1.0}, "^guidance over memory of -1.0"),
        ({"generator": [torch.Generator()]}, "^1 generators for 2 images; give one, or one for each$"),
        ({"memory_tokens": random_tokens(1, 5)}, "^memory_tokens of 1 samples, but 2 images$"),
        ({"callback_on_step_end_tensor_inputs": ["prompt"]}, "tensor_inputs has prompt; known: latents$"),
        ({"interactions": [(None,) * 3] * 2}, "^interactions of 3 steps; a clip of 9 frames has 8$"),
    ],
)
def test_arguments_that_cannot_be_sampled_are_refused(changes, cause):
    with pytest.raises(PersistError, match=cause):
        call(WorldPipeline.of(trained()), **changes)


@pytest.mark.parametrize("changes", [{"memory_tokens": random_tokens(2, 5)}, {"guidance_scale": 2.0}])
def test_a_memory_is_refused_where_no_adapter_reads_it(changes):
    backbone = trained()
    backbone.use_adapter(None)
    with pytest.raises(PersistError, match=r"^this model uses no memory adapter"):
        call(WorldPipeline.of(backbone), **PLAIN | changes)


def test_a_device_without_float64_is_refused(monkeypatch):
    monkeypatch.setattr(WorldPipeline, "_execution_device", torch.device("mps"))
    with pytest.raises(PersistError, match=r"float64, which mps lacks; stay on the CPU: pipe\.to\('cpu'\)$"):
        call(WorldPipeline.of(trained("projected")))


def test_depth_that_is_not_finite_is_missing_and_whole_numbers_are_no_metres():
    depth = torch.full((2, 32, 32), 2.0)
    depth[:, 3], depth[:, 4], depth[:, 5] = torch.nan, torch.inf, -1.0
    metres = batch_of_depth(depth)
    assert not metres[:, 3:6].any()
    assert torch.equal(metres[:, 6:], depth[:, 6:])
    with pytest.raises(PersistError, match=r"^depth of torch.int32; give floating point metres"):
        batch_of_depth(np.full((32, 32), 2000, np.int32))
    with pytest.raises(PersistError, match=r"^a floating point image of values up to 255; give them in \[0, 1\]$"):
        batch_of_images(torch.full((3, 32, 32), 255.0))


def test_images_depth_and_cameras_of_other_sizes_are_refused():
    pipeline, rgb, depth = WorldPipeline.of(trained()), CLIPS.rgb[:, 0], CLIPS.depth[:, 0]
    with pytest.raises(PersistError, match=r"^an image of 16x32 pixels; this model takes 32x32"):
        pipeline(rgb[:, :16], depth, CLIPS.cameras)
    with pytest.raises(PersistError, match=r"depth of 16x32 and cameras of 32x32; they must be one size$"):
        pipeline(rgb, depth[:, :16], CLIPS.cameras)
    with pytest.raises(
        PersistError, match=r"^clips of 5 frames, the given one included; this model makes clips of 9 frames$"
    ):
        pipeline(rgb, depth, CLIPS.cameras[(slice(None), slice(5))])


@pytest.mark.parametrize(
    ("image", "given"),
    [(torch.zeros(2, 32, 32, 1, dtype=torch.uint8), r"\[2, 32, 32, 1\] and torch.uint8"),
     (torch.zeros(32, 32, 3), r"\[32, 32, 3\] and torch.float32"),
     (torch.zeros(3, 32, 32, dtype=torch.uint8), r"\[3, 32, 32\] and torch.uint8"),
     (torch.zeros(32, 32, 3, dtype=torch.int64), r"\[32, 32, 3\] and torch.int64"), (torch.zeros(3), r"\[3\] and")],
)  # fmt: skip
def test_an_image_of_another_layout_is_named_as_it_was_given(image, given):
    wanted = r"give a PIL image, uint8 \[height, width, 3\], or floating point \[3, height, width\] in \[0, 1\]"
    with pytest.raises(PersistError, match=f"^an image of shape {given}.*{wanted}$"):
        batch_of_images(image)


@pytest.fixture
def checkpoints(tmp_path: Path) -> tuple[CogVideoX, Path, Path]:
    """A backbone, the folder of its base, and the folder of an adapter on that base."""
    backbone, base, stage2 = trained(), tmp_path / "base", tmp_path / "voxel"
    base.mkdir()
    stage2.mkdir()
    save_base(backbone, base)
    save_adapter(backbone, find_checkpoint(base), MemoryConfig("voxel"), stage2, stage2)
    return backbone, base, stage2


def test_one_call_makes_a_pipeline_of_a_checkpoint(checkpoints):
    backbone, base, stage2 = checkpoints
    before = torch.get_rng_state()
    loaded = persist_backbones.load(stage2)
    assert torch.equal(torch.get_rng_state(), before)
    assert same(call(loaded), call(WorldPipeline.of(backbone)))
    backbone.use_adapter(None)
    plain = call(WorldPipeline.of(backbone), **PLAIN)
    assert same(call(persist_backbones.load(base), **PLAIN), plain)
    assert same(call(persist_backbones.load(stage2, adapter="stage1"), **PLAIN), plain)
    for dtype in ("bfloat16", torch.bfloat16):
        assert persist_backbones.load(str(stage2), dtype=dtype).transformer.dtype == torch.bfloat16


def test_a_checkpoint_that_cannot_be_loaded_is_refused(checkpoints, tmp_path):
    _, base, stage2 = checkpoints
    with pytest.raises(PersistError, match=r"no memory adapter 'map2d' in it; it has voxel$"):
        persist_backbones.load(stage2, adapter="map2d")
    with pytest.raises(PersistError, match="unknown dtype 'bf16'; did you mean 'bfloat16'"):
        persist_backbones.load(stage2, dtype="bf16")
    with pytest.raises(PersistError, match="no checkpoint there"):
        persist_backbones.load(tmp_path / "nowhere")
    (base / "SHA256SUMS").unlink()
    (base / "persist.json").write_text((base / "persist.json").read_text().replace('"cogvideox"', '"dreamer"'))
    with pytest.raises(PersistError, match=r"a checkpoint of backbone 'dreamer', not of 'cogvideox'$"):
        persist_backbones.load(base)


def test_the_pipeline_of_diffusers_runs_the_parts_that_we_save(checkpoints):
    _, base, _ = checkpoints
    pipeline = CogVideoXImageToVideoPipeline(
        tokenizer=None, text_encoder=None,
        vae=AutoencoderKLCogVideoX.from_pretrained(base / "vae"),
        transformer=CogVideoXTransformer3DModel.from_pretrained(base / "transformer"),
        scheduler=CogVideoXDDIMScheduler.from_pretrained(base / "scheduler"),
    )  # fmt: skip
    pipeline.set_progress_bar_config(disable=True)
    output = pipeline(Image.fromarray(CLIPS.rgb[0, 0].numpy()), prompt_embeds=torch.zeros(1, 1, 8), num_frames=9,
                      height=32, width=32, num_inference_steps=2, guidance_scale=1.0, output_type="pt")  # fmt: skip
    assert output.frames.shape == (1, 9, 3, 32, 32)
    assert torch.isfinite(output.frames).all()
