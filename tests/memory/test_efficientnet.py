import pytest
import torch

from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.files import write_json, write_tensors
from persist_cli.io.hub import cached_weight
from persist_memory.encoders.efficientnet import EfficientNetLite0, EfficientNetLite0Settings, tensor_names
from tests.support.room_views import room_walk

FETCHED = pytest.mark.skipif(cached_weight("efficientnet-lite0") is None, reason="persist weights fetch first")


def make_encoder(**settings) -> EfficientNetLite0:
    return EfficientNetLite0(EfficientNetLite0Settings(**settings))


@FETCHED
@pytest.mark.parametrize(
    ("block", "shape", "values"),
    [
        (0, (1, 64, 64, 16), [[-8.8254, 5.166, -5.5805], [-4.9704, -3.0808, -9.5574], [-4.5922, -6.2777, -5.9954]]),
        (10, (1, 8, 8, 112), [[7.3437, 9.5722, 3.083], [-0.7605, 1.2382, -0.6949], [-6.6881, 5.3388, 5.5243]]),
    ],
)
def test_features_equal_those_of_the_library_that_released_the_weights(block, shape, values):
    rgb = (torch.arange(128 * 128 * 3).reshape(1, 128, 128, 3) * 7 % 256).to(torch.uint8)
    features = make_encoder(block=block).encode(rgb)
    assert features.shape == shape
    # recorded from efficientnet-lite-pytorch 0.1.0: channels 0, 7 and the last of three places
    sampled = torch.stack([features[0, row, column] for row, column in ((0, 0), (3, 5), (7, 7))])[:, [0, 7, -1]]
    torch.testing.assert_close(sampled, torch.tensor(values), atol=2e-3, rtol=0)


@FETCHED
def test_any_image_size_is_encoded_and_no_bit_of_a_frame_depends_on_its_neighbours():
    rgb = room_walk(3).rgb
    features = make_encoder(size=100).encode(rgb)
    assert features.shape == (3, 5, 7, make_encoder().channels)  # 75 × 100 pixels
    assert torch.equal(features[1:2], make_encoder(size=100).encode(rgb[1:2]))


def test_missing_weights_are_an_error_that_says_how_to_fetch_them(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    with pytest.raises(CheckpointError, match="not here: persist weights fetch efficientnet-lite0"):
        make_encoder().encode(room_walk(1).rgb)


def test_weights_that_lack_a_tensor_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    folder = tmp_path / "weights" / "efficientnet-lite0"
    folder.mkdir(parents=True)
    write_tensors(folder / "model.safetensors", {name: torch.ones(1) for name in list(tensor_names(10))[:-1]})
    write_json(folder / "weight.json", {})
    with pytest.raises(CheckpointError, match=r"it lacks _blocks\.10\._bn2\.running_var"):
        make_encoder().encode(room_walk(1).rgb)


@pytest.mark.parametrize("block", [-1, 16])
def test_a_block_number_beyond_the_network_is_refused(block):
    with pytest.raises(RecipeError, match=f"block {block} is not one of 0 to 15"):
        make_encoder(block=block)
