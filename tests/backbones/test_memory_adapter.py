"""Every form of memory adapter: a fresh one changes nothing, and a trained one depends on its tokens alone."""

import dataclasses
import math

import pytest
import torch

from persist_backbones.adapters.cross import token_rays
from persist_backbones.adapters.memory_block import MemoryBlock, Modulation, position_code
from persist_backbones.cogvideox.diffusion import sample_generators
from persist_cli.api.actions import rotation_about
from persist_cli.api.backbone import Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import plucker, unproject
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from tests.support.micro_model import (
    CHANNELS,
    POINT_FORMS,
    micro,
    predicted,
    random_clips,
    random_tokens,
    shaken,
    with_adapter,
)

QUICK = Sampling(steps=2)
every_form = pytest.mark.parametrize("form", POINT_FORMS)


CROSS = [{"normalize": True}, {"key_positions": True}, {"key_camera": True}, {"positions": "none"},
         {"key_camera": True, "ray_frequencies": 3},
         {"normalize": True, "key_positions": True, "key_camera": True}]  # fmt: skip
every_option_of_cross = pytest.mark.parametrize("options", CROSS, ids=lambda options: "+".join(options))


def padded(tokens: MemoryTokens, extra: int) -> MemoryTokens:
    """Append rubbish tokens that are masked out, in view and nearer than the others."""
    batch = len(tokens.features)
    near = torch.tensor([0.1, 0.1, 0.6], dtype=torch.float64).expand(batch, extra, 3)
    return MemoryTokens(
        torch.cat([tokens.features, torch.full((batch, extra, CHANNELS), 9.0)], 1),
        torch.cat([tokens.positions, near], 1),
        torch.cat([tokens.mask, torch.zeros(batch, extra, dtype=torch.bool)], 1),
        torch.cat([tokens.colors, torch.full((batch, extra, 3), 9, dtype=torch.uint8)], 1),
    )


@every_form
@pytest.mark.parametrize("count", [1, 30])
def test_an_untrained_adapter_changes_no_bit_of_the_prediction(form, count):
    backbone, clips = micro(), random_clips()
    shaken(backbone.transformer)
    bare = backbone.generate(clips, QUICK)
    with_adapter(backbone, form=form)
    opened = form == "rendered"  # moves the prediction towards what it renders from the start
    for tokens in (None, *([] if opened else [random_tokens(2, count)])):
        remembered = backbone.generate(dataclasses.replace(clips, tokens=tokens), QUICK)
        assert all(torch.equal(*pair) for pair in zip(bare, remembered, strict=True))


@every_form
def test_a_trained_adapter_uses_its_tokens(form):
    backbone, clips = with_adapter(micro(), form=form), random_clips()
    shaken(backbone)
    assert not torch.allclose(
        predicted(backbone, clips, random_tokens(2, 9)), predicted(backbone, clips, random_tokens(2, 9, 4))
    )


@every_form
def test_masked_padding_tokens_change_nothing(form):
    backbone, clips, tokens = with_adapter(micro(), form=form), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    assert torch.allclose(predicted(backbone, clips, tokens), predicted(backbone, clips, padded(tokens, 20)), atol=1e-5)


@every_form
def test_a_batch_may_hold_a_sample_without_any_token(form):
    backbone, clips = with_adapter(micro(), form=form), random_clips()
    shaken(backbone)
    tokens = random_tokens(2, 9)
    mixed = dataclasses.replace(tokens, mask=tokens.mask & torch.tensor([[True], [False]]))
    result = predicted(backbone, clips, mixed)
    assert result.isfinite().all()
    assert torch.allclose(result[1], predicted(backbone, clips, None)[1], atol=1e-5)
    assert torch.allclose(result[0], predicted(backbone, clips, tokens)[0], atol=1e-5)


@every_form
def test_every_parameter_of_an_adapter_has_a_gradient_within_two_steps(form):
    backbone = with_adapter(micro(), form=form)
    shaken(backbone.transformer)
    clips = random_clips(tokens=random_tokens(2, 60))  # so many that some are hidden from view by others
    parameters = backbone.trained_parameters("2")
    optimizer = torch.optim.AdamW(parameters.values(), lr=1e-2)
    with_gradient = set()
    for _ in range(2):
        optimizer.zero_grad()
        backbone(clips, "2")["loss"].backward()
        with_gradient |= {name for name, parameter in parameters.items() if parameter.grad.any()}
        optimizer.step()
    # a constant added to every key does not change a softmax
    assert [name for name in parameters.keys() - with_gradient if not name.endswith("to_key.bias")] == []


@every_form
def test_stage_two_trains_the_adapter_and_nothing_else(form):
    backbone = with_adapter(micro(), form=form)
    names = set(backbone.trained_parameters("2"))
    assert names
    assert all(name.startswith("adapters.voxel.") for name in names)
    assert {name for name, parameter in backbone.named_parameters() if parameter.requires_grad} == names


@every_form
def test_moving_the_whole_world_changes_no_prediction(form):
    backbone, clips, tokens = with_adapter(micro(), form=form), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = rotation_about(torch.tensor([0.6, 0.0, 0.8]), 1.1)
    motion[:3, 3] = torch.tensor([40.0, -3.0, 12.0])
    moved_cameras = Cameras(motion @ clips.cameras.world_from_camera, clips.cameras.intrinsics, 32, 32)
    moved_tokens = dataclasses.replace(tokens, positions=tokens.positions @ motion[:3, :3].T + motion[:3, 3])
    original = predicted(backbone, clips, tokens)
    moved = predicted(backbone, dataclasses.replace(clips, cameras=moved_cameras), moved_tokens)
    assert torch.allclose(original, moved, atol=1e-4)


@every_option_of_cross
def test_every_option_of_cross_begins_as_the_identity_and_depends_on_its_tokens_when_trained(options):
    backbone, clips = micro(), random_clips()
    shaken(backbone.transformer)
    bare = backbone.generate(clips, QUICK)
    with_adapter(backbone, **options)
    remembered = backbone.generate(dataclasses.replace(clips, tokens=random_tokens(2, 9)), QUICK)
    assert all(torch.equal(*pair) for pair in zip(bare, remembered, strict=True))
    shaken(backbone.adapters)
    one, other = (predicted(backbone, clips, random_tokens(2, 9, seed)) for seed in (3, 4))
    assert not torch.allclose(one, other)
    assert torch.allclose(one, predicted(backbone, clips, padded(random_tokens(2, 9), 20)), atol=1e-5)


@every_option_of_cross
def test_no_option_of_cross_but_absolute_positions_depends_on_the_worlds_origin(options):
    backbone, clips, tokens = with_adapter(micro(), **options), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    poses = clips.cameras.world_from_camera.clone()
    poses[..., :3, 3] += 40.0
    moved_clips = dataclasses.replace(clips, cameras=dataclasses.replace(clips.cameras, world_from_camera=poses))
    moved = dataclasses.replace(tokens, positions=tokens.positions + 40.0)
    assert torch.allclose(predicted(backbone, clips, tokens), predicted(backbone, moved_clips, moved), atol=1e-4)


@pytest.mark.parametrize(("options", "matters"), [({"positions": "none"}, False), ({"positions": "relative"}, True),
                                                  ({"positions": "none", "key_camera": True}, True)])  # fmt: skip
def test_tokens_without_positions_are_a_set_of_features_unless_keys_have_rays(options, matters):
    backbone, clips, tokens = with_adapter(micro(), **options), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    moved = dataclasses.replace(tokens, positions=tokens.positions.flip(1))
    same = torch.allclose(predicted(backbone, clips, tokens), predicted(backbone, clips, moved), atol=1e-6)
    assert same is not matters


@pytest.mark.parametrize("normalize", [True, False])
def test_normalized_features_count_whatever_their_length(normalize):
    backbone, clips, tokens = with_adapter(micro(), normalize=normalize), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    longer = dataclasses.replace(tokens, features=7 * tokens.features)
    same = torch.allclose(predicted(backbone, clips, tokens), predicted(backbone, clips, longer), atol=1e-3)
    assert same is normalize


@pytest.mark.parametrize(
    "options", [options for options in CROSS if "key_camera" in options], ids=lambda options: "+".join(options)
)
def test_with_rays_in_the_keys_a_sample_does_not_see_the_memory_of_another(options):
    backbone, clips, tokens = with_adapter(micro(), **options), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    features = tokens.features * torch.tensor([1.0, -2.0])[:, None, None]
    mask = tokens.mask & torch.tensor([[True], [False]])
    before, changed, hidden = (
        predicted(backbone, clips, dataclasses.replace(tokens, features=values, mask=there))
        for values, there in ((tokens.features, tokens.mask), (features, tokens.mask), (tokens.features, mask))
    )
    assert torch.allclose(before[0], changed[0], atol=1e-5)
    assert torch.allclose(before[0], hidden[0], atol=1e-5)
    assert not torch.allclose(before[1], changed[1], atol=1e-5)


def test_the_ray_to_a_token_has_the_direction_of_the_pixel_that_sees_it():
    clips = random_clips(batch=1)
    cameras = dataclasses.replace(clips.cameras, world_from_camera=clips.cameras.world_from_camera.clone())
    depth = torch.full((1, 9, 32, 32), 2.0)
    place = unproject(depth, cameras)[:, 5, 7, 11]
    tokens = MemoryTokens(torch.zeros(1, 1, CHANNELS), place[:, None], torch.ones(1, 1, dtype=torch.bool))
    ray, pixel = token_rays(tokens, cameras)[0, 5, 0], plucker(cameras)[0, 5, 7, 11]
    torch.testing.assert_close(ray, pixel / pixel[3:].norm(), atol=1e-9, rtol=0)


def test_queries_and_keys_have_the_same_code_of_a_direction():
    adapter = with_adapter(micro(), key_camera=True, ray_frequencies=3).adapter
    rays = torch.randn(2, 5, 6 * adapter.video.folded)
    coded, longer = adapter.with_direction_code(rays), adapter.with_direction_code(2 * rays)
    assert coded.shape == (2, 5, 4 * 6 * adapter.video.folded)
    assert torch.equal(coded[..., : rays.shape[-1]], rays)
    torch.testing.assert_close(coded[..., rays.shape[-1] :], longer[..., rays.shape[-1] :])
    near = rays.clone()
    near[..., 3] += 0.1 * near[..., 3:6].norm(dim=-1)
    assert not torch.allclose(adapter.with_direction_code(near)[..., rays.shape[-1] :], coded[..., rays.shape[-1] :])


def test_a_code_of_rays_needs_the_rays():
    with pytest.raises(CheckpointError, match="give key_camera=true"):
        with_adapter(micro(), ray_frequencies=3)


def test_keys_have_the_code_of_positions_where_the_settings_say_so():
    clips, tokens = random_clips(), random_tokens(2, 9)
    adapter = with_adapter(micro(), key_positions=True).adapter
    code = adapter.position_code(tokens, clips.cameras)
    assert torch.equal(adapter.prepare(tokens, clips.cameras).codes[:, 0], code)
    assert with_adapter(micro()).adapter.prepare(tokens, clips.cameras).codes is None


def test_positions_in_the_keys_need_positions():
    with pytest.raises(CheckpointError, match="key_positions needs positions"):
        with_adapter(micro(), positions="none", key_positions=True)


@pytest.mark.parametrize(("dropout", "hides"), [(0.0, False), (1.0, True)])
def test_training_hides_the_memory_where_the_dropout_says_so(dropout, hides):
    backbone, clips = with_adapter(micro(), dropout=dropout), random_clips(2, random_tokens(2, 40))
    shaken(backbone)
    losses = [backbone(seen, "2")["loss"] for seen in (clips, dataclasses.replace(clips, tokens=None))]
    assert torch.equal(*losses) == hides


def test_training_hides_the_memory_from_a_share_of_the_samples_and_sampling_from_none():
    backbone, clips = with_adapter(micro(), dropout=0.2), random_clips(60, random_tokens(60, 3))
    trained, sampled = (backbone.memory_condition(clips, draws) for draws in (sample_generators(clips.seeds), None))
    assert sampled.memory.mask.all()
    assert 4 <= (~trained.memory.mask.any(dim=1)).sum() <= 22


def test_absolute_positions_depend_on_the_origin_of_the_world():
    backbone, clips, tokens = with_adapter(micro(), positions="absolute"), random_clips(), random_tokens(2, 9)
    shaken(backbone)
    moved = dataclasses.replace(tokens, positions=tokens.positions + 1.0)
    assert not torch.allclose(predicted(backbone, clips, tokens), predicted(backbone, clips, moved))


@every_form
def test_memory_guidance_of_weight_one_changes_nothing_and_more_moves_away_from_no_memory(form):
    backbone, clips = with_adapter(micro(), form=form), random_clips(tokens=random_tokens(2, 9))
    shaken(backbone)
    plain, strong = (backbone.generate(clips, Sampling(2, "ddim", weight))[1] for weight in (1.0, 3.0))
    assert not torch.equal(plain, strong)
    without = dataclasses.replace(clips, tokens=None)
    assert torch.allclose(
        backbone.generate(without, Sampling(2, "ddim", 3.0))[1], backbone.generate(without, QUICK)[1], atol=1e-3
    )


@torch.no_grad()
def test_memory_guidance_goes_from_no_memory_through_the_prediction_with_it():
    backbone, clips = with_adapter(micro()), random_clips(tokens=random_tokens(2, 9))
    shaken(backbone)
    latents, image = backbone.codec.encode(clips.rgb, clips.depth), backbone.encode_first(clips)
    conditions = backbone.conditions(clips, torch.full((2,), 500), backbone.memory_condition(clips))
    without, plain, strong = (backbone.predict_guided(latents, image, conditions, weight) for weight in (0.0, 1.0, 3.0))
    torch.testing.assert_close(without, predicted(backbone, clips, None))
    torch.testing.assert_close(strong, without + 3 * (plain - without))
    assert not torch.allclose(strong, plain, atol=1e-3)


def test_shift_scale_and_gate_of_the_memory_are_its_own_and_those_of_the_video_are_the_videos():
    torch.manual_seed(0)
    block = MemoryBlock(video_channels=8, camera_channels=6, width=4, heads=2, ff_factor=1.0, time_channels=5)
    shaken(block, 1.0)
    inputs = {"memory": torch.randn(1, 3, 4), "mask": torch.ones(1, 3, dtype=torch.bool)}
    inputs |= {"camera": torch.randn(1, 2, 6), "time": torch.randn(1, 5)}
    video, others = torch.randn(1, 2, 8), torch.randn(1, 3, 4)

    def after(**modulation):
        """The change of the video by two memories; what is not named of shift, scale and gate is zero."""
        parts = [
            torch.full((size,), modulation.get(name, 0.0))
            for name, size in zip(Modulation._fields, block.sizes, strict=True)
        ]
        with torch.no_grad():
            block.modulation.weight.zero_()
            block.modulation.bias.copy_(torch.cat(parts))
            return [block(video, **inputs | {"memory": memory}) - video for memory in (inputs["memory"], others)]

    one, other = after(video_gate=-1.0)
    assert one.any()
    assert not torch.allclose(one, other, atol=1e-3)
    assert not any(change.any() for change in after(video_gate=-1.0, memory_gate=-1.0))
    for closed in ({"memory_gate": -1.0}, {"memory_scale": -1.0, "memory_shift": 0.5}):
        one, other = after(**closed)
        assert one.any()
        assert torch.allclose(one, other, atol=1e-6)
    scaled, plain = after(video_gate=-1.0, video_scale=0.7)[0], after(video_gate=-1.0)[0]
    assert not torch.allclose(scaled, plain, atol=1e-3)


def test_memory_tokens_count_by_their_direction_whatever_their_length():
    torch.manual_seed(0)
    block = MemoryBlock(video_channels=8, camera_channels=6, width=4, heads=2, ff_factor=1.0, time_channels=5)
    shaken(block, 1.0)
    video, memory, mask = torch.randn(1, 2, 8), torch.randn(1, 3, 4), torch.ones(1, 3, dtype=torch.bool)
    camera, time = torch.randn(1, 2, 6), torch.randn(1, 5)
    once, longer = (block(video, factor * memory, mask, camera, time) for factor in (10.0, 20.0))
    assert torch.allclose(once, longer, atol=1e-3)


def test_an_adapter_has_a_block_at_every_nth_layer():
    assert set(with_adapter(micro(), every=2).adapter.blocks) == {"1"}
    assert set(with_adapter(micro()).adapter.blocks) == {"0", "1"}
    assert set(with_adapter(micro(), form="projected", every=2).adapter.blocks) == {"1"}
    assert set(with_adapter(micro(), form="canvas", every=2).adapter.blocks) == {"0"}
    assert set(with_adapter(micro(), form="canvas").adapter.blocks) == {"0", "1"}


@every_form
def test_an_adapter_survives_saving_to_the_bit(form, tmp_path):
    backbone = with_adapter(micro(), form=form)
    shaken(backbone.adapters)
    backbone.save_adapter(tmp_path)
    loaded = micro()
    loaded.load_adapter("voxel", tmp_path)
    assert all(
        torch.equal(value, loaded.adapters.state_dict()[name]) for name, value in backbone.adapters.state_dict().items()
    )


def test_adapters_and_tokens_that_do_not_fit_are_refused(tmp_path):
    backbone = with_adapter(micro())
    backbone.save_adapter(tmp_path)
    (tmp_path / "adapter.safetensors").write_bytes(b"rubbish")
    with pytest.raises(CheckpointError, match="not a whole safetensors file"):
        backbone.load_adapter("voxel", tmp_path)
    narrow = random_clips(tokens=MemoryTokens.stack([MemoryTokens.empty(3)] * 2))
    with pytest.raises(CheckpointError, match="features of 3 channels"):
        backbone.generate(narrow, QUICK)
    with pytest.raises(CheckpointError, match="no memory adapter 'map2d'; there are: voxel"):
        backbone.use_adapter("map2d")


def test_the_position_code_is_bounded_and_differs_between_cells():
    code = position_code(torch.tensor([[0.0, 0, 0], [0.25, 0, 0], [60.0, 0, 0]]), 10)
    assert code.abs().max() <= 1
    assert torch.pdist(code).min() > 0.5


def test_wavelengths_of_the_position_code_go_from_the_shortest_to_the_longest_in_equal_ratios():
    near, far = (position_code(torch.tensor([[place, 0.0, 0.0]]), 3, 0.5, 8.0)[0, :6] for place in (0.5, 2.0))
    quarter = torch.tensor([0.25 * 2 * math.pi, 2 * math.pi / 16])
    assert torch.allclose(
        near, torch.cat([torch.tensor([0.0]), quarter.sin(), torch.tensor([1.0]), quarter.cos()]), atol=1e-6
    )
    assert torch.allclose(far[:3], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)
