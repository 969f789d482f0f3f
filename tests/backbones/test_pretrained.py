"""Pretrained weights from a directory, or from the hub, which is used only for files that are not in its cache."""

import shutil
import weakref

import pytest
import torch

from persist_backbones.cogvideox import parts
from persist_backbones.cogvideox.diffusion import SAMPLERS, make_scheduler
from persist_backbones.cogvideox.parts import folder_here, pretrained_folder, published_preset
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_json, read_tensors, write_json, write_tensors
from persist_cli.plugins import make_backbone
from tests.support.twins import SIZE, load_twin, write_snapshot, write_twin

NAME = "zai-org/CogVideoX-5b-I2V"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of the hub, which itself is offline."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "hub"


@pytest.fixture
def snapshot(cache):
    """A twin in the hub's cache."""
    return write_twin("5b-i2v", write_snapshot(cache, NAME))


def test_a_name_on_the_hub_is_opened_from_the_cache_without_the_network(snapshot):
    by_name, by_folder = load_twin(NAME), load_twin(snapshot)
    assert pretrained_folder(NAME) == snapshot
    pairs = zip(by_name.state_dict().values(), by_folder.state_dict().values(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)


def test_a_model_in_the_cache_under_its_publishers_former_name_is_found(cache):
    snapshot = write_twin("5b-i2v", write_snapshot(cache, "THUDM/CogVideoX-5b-I2V"))
    assert pretrained_folder(NAME) == snapshot
    assert folder_here("someone/CogVideoX-5b-I2V") is None


def test_a_local_directory_comes_before_a_name_on_the_hub(snapshot, tmp_path):
    shutil.copytree(snapshot, tmp_path / NAME)
    assert str(pretrained_folder(NAME)) == NAME


@pytest.mark.parametrize("spacing", [{}, {"timestep_spacing": "linspace"}])  # none is diffusers' default: leading
def test_sampling_begins_at_pure_noise_whatever_spacing_of_steps_the_files_name(tmp_path, spacing):
    path = write_twin("2b", tmp_path) / "scheduler" / "scheduler_config.json"
    write_json(path, {key: value for key, value in read_json(path).items() if key != "timestep_spacing"} | spacing)
    config = load_twin(tmp_path).scheduler.config
    for sampler in SAMPLERS:
        scheduler = make_scheduler(config, sampler, 4)
        assert scheduler.timesteps.tolist() == [999, 749, 499, 249]
    assert config.timestep_spacing == "trailing"


@pytest.mark.parametrize("part", ["transformer", "vae", "scheduler"])
def test_an_incomplete_download_is_refused(snapshot, part):
    next(path for path in (snapshot / part).iterdir() if path.suffix == ".safetensors" or part == "scheduler").unlink()
    with pytest.raises(CheckpointError, match="not whole in the hub's cache, and the hub: HF_HUB_OFFLINE is set; give"):
        pretrained_folder(NAME)


def test_weights_in_half_precision_go_one_by_one_as_they_are_converted(snapshot, monkeypatch):
    """Of eight processes each reads the whole model: 11 GB of CogVideoX-5B more than the 22 GB that it keeps."""
    path = snapshot / "transformer" / parts.WEIGHTS
    write_tensors(path, {name: tensor.bfloat16() for name, tensor in read_tensors(path)[0].items()})
    read, left, load = [], [], torch.nn.Module.load_state_dict

    def read_and_noted(path):
        tensors, metadata = read_tensors(path)
        read.extend(map(weakref.ref, tensors.values()))
        return tensors, metadata

    def counted(module, *arguments, **options):
        left.append(sum(tensor() is not None for tensor in read))
        return load(module, *arguments, **options)

    monkeypatch.setattr(parts, "read_tensors", read_and_noted)
    monkeypatch.setattr(torch.nn.Module, "load_state_dict", counted)
    assert parts.load_part(snapshot, "transformer").dtype == torch.float32
    assert len(read) > 1 >= left[0]


def test_weights_that_lack_a_shard_are_refused(snapshot):
    model = load_twin(snapshot)
    (snapshot / "transformer" / "diffusion_pytorch_model.safetensors").unlink()
    model.transformer.base.save_pretrained(snapshot / "transformer", max_shard_size="20KB")
    assert pretrained_folder(NAME) == snapshot
    next((snapshot / "transformer").glob("*-of-*.safetensors")).unlink()
    with pytest.raises(CheckpointError, match="not whole in the hub's cache"):
        pretrained_folder(NAME)


def test_a_name_that_is_neither_here_nor_on_the_hub_is_refused_at_once(cache, monkeypatch):
    with pytest.raises(CheckpointError, match=f"^{NAME}: no such directory, .* hf download {NAME} --include") as error:
        load_twin(NAME)
    assert "\n" not in str(error.value)
    with pytest.raises(CheckpointError, match=r"^runs/a/b: no such directory, and not the name of a repository"):
        load_twin("runs/a/b")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with pytest.raises(CheckpointError, match=r"http://127.0.0.1:9 does not answer"):
        load_twin(NAME)


def test_a_meta_model_of_weights_that_are_not_here_has_the_size_of_their_name(cache):
    frames, height, width = SIZE
    with torch.device("meta"):
        settings = {"pretrained": NAME, "frames": frames, "height": height, "width": width}
        model = make_backbone("cogvideox", settings)
    assert model.transformer.base.config.num_layers == 42
    assert folder_here(NAME) is None


def test_a_meta_model_of_weights_in_the_cache_has_their_size(snapshot):
    with torch.device("meta"):
        model = load_twin(NAME)
    assert model.transformer.base.config.num_layers == 2
    assert model.prompt.is_meta


def test_the_names_of_both_publishers_are_known():
    presets = [published_preset(f"{owner}/CogVideoX1.5-5B-I2V") for owner in ("THUDM", "zai-org", "someone")]
    assert presets == ["1.5-5b-i2v", "1.5-5b-i2v", None]


@pytest.mark.parametrize(
    ("layers", "cause"), [(3, "lack .* first 'transformer_blocks.2"), (1, "have besides .*blocks.1")]
)
def test_weights_of_another_configuration_are_refused(tmp_path, layers, cause):
    config = write_twin("5b-i2v", tmp_path) / "transformer" / "config.json"
    write_json(config, read_json(config) | {"num_layers": layers})
    with pytest.raises(CheckpointError, match=rf"transformer: its weights {cause}.*take a whole copy of both"):
        load_twin(tmp_path, SIZE)


def test_a_missing_or_malformed_part_is_refused_in_one_line_without_messages_of_diffusers(tmp_path, capfd, caplog):
    folder = write_twin("5b-i2v", tmp_path) / "transformer"
    weights = folder / "diffusion_pytorch_model.safetensors"
    tensors = read_tensors(weights)[0]
    write_tensors(weights, {name: tensor for name, tensor in tensors.items() if name != "patch_embed.pos_embedding"})
    with pytest.raises(CheckpointError, match=r"its weights lack 1 tensors .*, first 'patch_embed.pos_embedding'"):
        load_twin(tmp_path, SIZE)
    weights.unlink()
    with pytest.raises(CheckpointError, match=f"transformer: no {weights.name} in it; take a whole copy"):
        load_twin(tmp_path, SIZE)
    (folder / "config.json").write_text("[]")
    with pytest.raises(CheckpointError, match="transformer: its configuration is no mapping"):
        load_twin(tmp_path, SIZE)
    assert capfd.readouterr().err + caplog.text == ""


def test_weights_of_other_shapes_are_refused_with_the_name_of_one(tmp_path):
    config = write_twin("2b", tmp_path) / "transformer" / "config.json"
    write_json(config, read_json(config) | {"num_attention_heads": 4})
    with pytest.raises(CheckpointError, match=r"transformer: cannot be loaded \(.*shape") as error:
        load_twin(tmp_path, SIZE)
    assert "\n" not in str(error.value)
