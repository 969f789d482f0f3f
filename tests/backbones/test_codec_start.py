"""The start of a small codec as the principal components of squares of pixels."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from persist_backbones.cogvideox.codec_start import Components
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Clips
from persist_cli.errors import CheckpointError
from tests.backbones.test_codec import FRAMEWISE
from tests.support.micro_model import micro, random_clips

WIDER = {"vae": FRAMEWISE["vae"] | {"block_out_channels": [16]}}


def smooth_clips(count: int) -> Clips:
    """Clips of a few large blurred spots, of which a linear code loses little."""
    clips = random_clips(count)
    spots = torch.rand(count * 9, 3, 6, 6, generator=torch.Generator().manual_seed(3)) * 255
    rgb = F.interpolate(spots, size=clips.rgb.shape[2:4], mode="bicubic").clamp(0, 255)
    rgb = rgb.permute(0, 2, 3, 1).to(torch.uint8).unflatten(0, (count, -1))
    return Clips(rgb, 1 + rgb[..., 0] / 64, clips.cameras, clips.interactions, None, clips.seeds)


def psnr(backbone: CogVideoX, clips: Clips) -> float:
    """PSNR of coded colours in dB."""
    coded, _ = backbone.reconstruct(clips)
    return float(-10 * torch.log10(((coded.float() - clips.rgb.float()) / 255).square().mean()))


def test_a_fresh_codec_codes_nearly_as_well_as_its_principal_components() -> None:
    clips, backbone = smooth_clips(2), micro(**WIDER, codec_start="components").eval()
    before = psnr(backbone, clips)
    backbone.begin_stage("codec", [clips])
    images = backbone.codec.images(clips.rgb, clips.depth)
    squares = F.pixel_unshuffle(images.transpose(1, 2).flatten(0, 1), 4).permute(0, 2, 3, 1).flatten(0, 2)
    components = Components.of(squares, backbone.codec.channels)
    linear = components.coefficients(squares) / components.scales @ components.directions.T + components.mean
    lost = ((linear - squares)[: len(squares) // 2] / 2).square().mean()
    assert before < 15 < psnr(backbone, clips)
    assert psnr(backbone, clips) > float(-10 * torch.log10(lost)) - 3


def test_it_begins_with_the_same_weights_each_time() -> None:
    first, second = (micro(**WIDER, codec_start="components") for _ in range(2))
    second.load_state_dict(first.state_dict())
    for backbone in (first, second):
        backbone.begin_stage("codec", [smooth_clips(1)])
    assert first.encoding() == second.encoding()


def test_other_stages_and_a_random_start_leave_the_codec_as_it_is() -> None:
    for backbone, stage in ((micro(**WIDER), "codec"), (micro(**WIDER, codec_start="components"), "1")):
        before = backbone.encoding()
        backbone.begin_stage(stage, [smooth_clips(1)])  # type: ignore[arg-type]
        assert backbone.encoding() == before


def test_the_scaled_coefficients_have_a_mean_square_of_one() -> None:
    squares = torch.randn(500, 12, generator=torch.Generator().manual_seed(0)) * torch.arange(1, 13)
    coefficients = Components.of(squares, 4).coefficients(squares)
    torch.testing.assert_close(coefficients.square().mean(), torch.tensor(1.0), rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    "vae",
    [{"latent_channels": 4}, FRAMEWISE["vae"] | {"norm_num_groups": 4}],
    ids=["three blocks", "too narrow"],
)
def test_a_codec_without_room_for_it_is_refused(vae: dict) -> None:
    backbone = micro(vae=vae, codec_start="components")
    with pytest.raises(CheckpointError, match="codec_start components needs a VAE of one block"):
        backbone.begin_stage("codec", [random_clips(1)])


def test_the_weight_of_a_channel_is_what_it_changes_in_decoded_pixels() -> None:
    clips, backbone = smooth_clips(2), micro(**WIDER, codec_start="components").eval()
    backbone.begin_stage("codec", [clips])
    squares = F.pixel_unshuffle(backbone.codec.images(clips.rgb, clips.depth).transpose(1, 2).flatten(0, 1), 4)
    wanted = Components.of(squares.permute(0, 2, 3, 1).flatten(0, 2), backbone.codec.channels).scales ** -2
    weights = backbone.codec.pixel_weights()
    assert weights.mean().item() == pytest.approx(1)
    assert torch.allclose(weights, wanted / wanted.mean(), rtol=0.3)
    assert weights.max() > 3 * weights.min()
