"""The form ``frames``: whole remembered frames, encoded by the codec, reach the video by their rays alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.actions import rotation_about
from persist_cli.api.backbone import Clips, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from tests.support.micro_model import (
    equal,
    micro,
    predicted,
    predicted_of,
    random_clips,
    random_tokens,
    shaken,
    with_adapter,
)
from tests.support.micro_runs import SIZE


def random_frames(count: int, batch: int = 2, seed: int = 4) -> MemoryTokens:
    """Frames of noise from random poses near the origin."""
    tokens, draw = random_tokens(batch, count, seed), torch.Generator().manual_seed(seed)
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, count, 1, 1)
    poses[..., :3, 3] = tokens.positions
    return dataclasses.replace(
        tokens,
        images=torch.randint(0, 256, (batch, count, SIZE, SIZE, 3), generator=draw, dtype=torch.uint8),
        world_from_camera=poses,
        intrinsics=random_clips(batch).cameras.intrinsics[:, :1].expand(-1, count, -1, -1),
    )


def trained(**settings: float) -> CogVideoX:
    """A micro model with an adapter whose weights are no longer fresh."""
    backbone = with_adapter(micro(), form="frames", **settings)
    shaken(backbone)
    return backbone


def test_an_untrained_adapter_changes_no_bit_of_the_prediction() -> None:
    backbone, clips = micro(), random_clips()
    shaken(backbone.transformer)
    bare = predicted(backbone, clips, None)
    with_adapter(backbone, form="frames")
    assert torch.equal(predicted(backbone, clips, random_frames(3)), bare)


def test_images_poses_and_origins_of_the_frames_reach_the_video() -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(3)
    seen = predicted(backbone, clips, frames)
    turned, imagined = frames.world_from_camera.clone(), torch.full_like(frames.origins, Origin.IMAGINED)
    turned[..., :3, :3] = rotation_about(torch.tensor([0.0, 1.0, 0.0]), 0.5)
    changes = ({"images": frames.images.flip(1)}, {"world_from_camera": turned}, {"origins": imagined})
    for change in changes:
        assert not torch.allclose(predicted(backbone, clips, dataclasses.replace(frames, **change)), seen, atol=1e-4)


def test_the_order_of_frames_and_padding_change_nothing() -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(3)
    flipped = MemoryTokens(**{name: part.flip(1) for name, part in frames.tensors().items()})
    padded = MemoryTokens.stack([frames[0], frames[1], random_frames(5)[0]])
    padded = MemoryTokens(**{name: part[:2] for name, part in padded.tensors().items()})
    seen = predicted(backbone, clips, frames)
    assert torch.allclose(predicted(backbone, clips, flipped), seen, atol=1e-5)
    assert torch.allclose(predicted(backbone, clips, padded), seen, atol=1e-5)


def test_moving_the_whole_world_changes_nothing() -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(3)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = rotation_about(torch.tensor([0.6, 0.0, 0.8]), 1.1)
    motion[:3, 3] = torch.tensor([40.0, -3.0, 12.0])
    cameras = Cameras(motion @ clips.cameras.world_from_camera, clips.cameras.intrinsics, SIZE, SIZE)
    moved = dataclasses.replace(frames, world_from_camera=motion @ frames.world_from_camera)
    still = predicted(backbone, clips, frames)
    assert torch.allclose(predicted(backbone, dataclasses.replace(clips, cameras=cameras), moved), still, atol=1e-4)


def test_an_emptied_memory_is_no_memory() -> None:
    backbone, clips = trained(), random_clips()
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=random_frames(3)))
    assert torch.allclose(predicted_of(backbone, clips, memory.emptied()), predicted(backbone, clips, None), atol=1e-5)


def test_without_frames_every_parameter_has_a_gradient_too_as_processes_that_train_together_need() -> None:
    backbone = with_adapter(micro(), form="frames", learned_tokens=2)
    backbone(random_clips(), "2")["loss"].backward()
    missing = [name for name, parameter in backbone.trained_parameters("2").items() if parameter.grad is None]
    assert missing == []


def test_every_parameter_has_a_gradient_within_two_steps() -> None:
    backbone = with_adapter(micro(), form="frames", learned_tokens=2)
    shaken(backbone.transformer)
    clips = random_clips(tokens=random_frames(3))
    parameters = backbone.trained_parameters("2")
    optimizer = torch.optim.AdamW(parameters.values(), lr=1e-2)
    with_gradient = set()
    for _ in range(2):
        optimizer.zero_grad()
        backbone(clips, "2")["loss"].backward()
        with_gradient |= {name for name, parameter in parameters.items() if parameter.grad.any()}
        optimizer.step()
    assert [name for name in parameters.keys() - with_gradient if not name.endswith("to_key.bias")] == []


def test_what_a_cache_keeps_has_latents_in_the_place_of_images_and_predicts_the_same() -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(3)
    kept = backbone.keep_tokens(dataclasses.replace(clips, tokens=frames))
    assert kept.images is None
    assert kept.latents is not None
    assert torch.equal(predicted(backbone, clips, kept), predicted(backbone, clips, frames))
    assert backbone.token_encoding()


def test_a_batch_may_hold_a_sample_without_a_frame_before_and_after_it_was_kept() -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(2)
    nothing = MemoryTokens(**{name: part[:0] for name, part in frames[0].tensors().items()})
    kept = [backbone.keep_tokens(one_clip(clips, tokens))[0] for tokens in (frames[0], nothing)]
    for samples in ([frames[0], nothing], kept):
        result = predicted(backbone, clips, MemoryTokens.stack(samples))
        assert torch.allclose(result[0], predicted(backbone, clips, frames)[0], atol=1e-5)
        assert torch.allclose(result[1], predicted(backbone, clips, None)[1], atol=1e-5)


def one_clip(clips: Clips, tokens: MemoryTokens) -> Clips:
    """The first clip with the tokens of one sample."""
    cameras = clips.cameras[:1]
    return dataclasses.replace(clips, cameras=cameras, tokens=MemoryTokens.stack([tokens]), seeds=clips.seeds[:1])


def test_an_adapter_survives_saving_and_bfloat16(tmp_path: Path) -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(2)
    backbone.save_adapter(tmp_path)
    loaded = micro()
    loaded.load_adapter("context", tmp_path)
    assert equal([*backbone.adapters.parameters()], [*loaded.adapters.parameters()])
    low = dataclasses.replace(clips, tokens=frames)
    assert backbone.to(torch.bfloat16).generate(low, Sampling(2, "ddim", 1.5))[1].isfinite().all()


def test_as_many_tokens_are_counted_as_the_adapter_attends_to() -> None:
    backbone, clips, frames = trained(), random_clips(), random_frames(3)
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=frames))
    assert backbone.count_tokens(frames[0], clips.cameras[0]) == memory.memory.mask[0].sum() == 3 * 4**2


def test_points_are_refused_in_one_line() -> None:
    with pytest.raises(CheckpointError, match="'frames' reads whole frames, but this memory's tokens are points"):
        predicted(trained(), random_clips(), random_tokens(2, 9))


def test_frames_that_cannot_be_cut_into_whole_patches_are_refused() -> None:
    with pytest.raises(CheckpointError, match="frame_patch is 3; it must divide"):
        micro().add_adapter("context", 8, {"form": "frames", "frame_patch": 3})
