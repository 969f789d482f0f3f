"""The prompt's embedding: computed by a local T5, read from a file, or zeros, and never downloaded."""

import shutil

import pytest
import torch
from diffusers import CogVideoXPipeline
from transformers import T5EncoderModel, T5Tokenizer

from persist_backbones import write_prompt
from persist_cli.api.checkpoint import step_folders
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors, write_tensors
from persist_cli.plugins import make_backbone
from tests.support.micro_model import micro
from tests.support.text_encoder import write_text_encoder
from tests.support.twins import load_twin, write_snapshot, write_twin

PROMPT = "a walk"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A twin with tokenizer and text encoder, as diffusers' pipeline saves them."""
    home = write_twin("2b", tmp_path_factory.mktemp("twin"))
    write_text_encoder(home)
    return home


def test_a_prompt_is_embedded_as_diffusers_pipeline_embeds_it(folder):
    ours = load_twin(folder, prompt=PROMPT).prompt
    encoder = T5EncoderModel.from_pretrained(folder / "text_encoder")
    pipe = CogVideoXPipeline(T5Tokenizer.from_pretrained(folder / "tokenizer"), encoder, None, None, None)
    with torch.no_grad():
        expected, _ = pipe.encode_prompt(PROMPT, do_classifier_free_guidance=False, max_sequence_length=10)
    assert torch.equal(ours, expected)
    assert ours.any()
    assert not torch.equal(load_twin(folder, prompt="").prompt, ours)


def test_pretrained_weights_get_the_embedding_of_the_empty_prompt_unless_zeros_are_asked_for(folder, tmp_path):
    size = {"frames": 17, "height": 32, "width": 48}
    default = make_backbone("cogvideox", {"pretrained": str(folder)} | size)
    assert torch.equal(default.prompt, load_twin(folder, prompt="").prompt)
    assert default.prompt.any()
    assert not load_twin(folder, prompt=None).prompt.any()
    alone = shutil.copytree(folder, tmp_path / "alone", ignore=shutil.ignore_patterns("text_encoder"))
    with pytest.raises(CheckpointError, match=r"no text_encoder/ to embed the prompt '' with; give .*prompt=null for"):
        make_backbone("cogvideox", {"pretrained": str(alone)} | size)


def test_a_processor_that_is_slow_in_half_precision_embeds_in_float32(folder, tmp_path, monkeypatch):
    exact = load_twin(folder, prompt=PROMPT).prompt
    half = shutil.copytree(folder, tmp_path / "half")
    T5EncoderModel.from_pretrained(half / "text_encoder", dtype=torch.bfloat16).save_pretrained(half / "text_encoder")
    errors = {}
    for slow in (False, True):
        monkeypatch.setattr("persist_backbones.cogvideox.prompt.is_slow", lambda dtype, slow=slow: slow)
        prompt = load_twin(half, prompt=PROMPT).prompt
        errors[slow] = float((prompt - exact).abs().max())
        assert torch.equal(prompt, prompt.bfloat16().float()) is not slow
    assert errors[True] < errors[False]


def test_a_run_goes_on_with_the_prompt_of_its_checkpoint(folder, walks, persist, tmp_path):
    twin, run = shutil.copytree(folder, tmp_path / "twin"), tmp_path / "run"
    changes = [f"backbone.settings.pretrained={twin}", "backbone.settings.height=32", "backbone.settings.width=32"]
    changes += ["training.steps=1", "training.batch=1", "training.accumulation=1", "training.precision=no"]
    command = ["finetune", "cogvideox-2b-stage1", "--data", walks, "--out", run, "training.workers=0", *changes]
    ended = persist(*command)
    assert ended.code == 0, ended.err
    shutil.rmtree(twin / "text_encoder")
    (run / "prompt.safetensors").unlink()
    ended = persist(*command, "--resume", "training.steps=2")
    assert ended.code == 0, ended.err
    first, last = (read_tensors(step / "model" / "world.safetensors")[0]["prompt"] for step in step_folders(run))
    assert torch.equal(first, last)
    assert torch.equal(first, load_twin(folder, prompt="").prompt)


def test_a_model_that_starts_from_no_weights_knows_no_text_and_has_zeros():
    assert not micro().prompt.any()


def test_a_checkpoint_stores_the_embedding_of_its_prompt_and_needs_no_t5(folder, tmp_path):
    model = load_twin(folder, prompt=PROMPT)
    model.save_base(tmp_path)
    settings = model.checkpoint_settings()
    assert (settings["pretrained"], settings["prompt"], settings["prompt_embedding"]) == (None, None, None)
    loaded = make_backbone("cogvideox", settings)
    loaded.load_base(tmp_path)
    assert torch.equal(loaded.prompt, model.prompt)


def test_a_model_from_an_embedding_equals_the_one_from_its_prompt(folder, tmp_path):
    alone = tmp_path / "without T5"
    shutil.copytree(folder, alone, ignore=shutil.ignore_patterns("text_encoder", "tokenizer"))
    write_prompt(PROMPT, str(folder), tmp_path / "walk.safetensors")
    model = load_twin(alone, prompt_embedding=str(tmp_path / "walk.safetensors"))
    assert torch.equal(model.prompt, load_twin(folder, prompt=PROMPT).prompt)
    model.save_base(alone)
    assert torch.equal(load_twin(alone, prompt_embedding=str(alone / "world.safetensors")).prompt, model.prompt)
    assert read_tensors(tmp_path / "walk.safetensors")[0].keys() == {"prompt"}


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"prompt": "a", "prompt_embedding": "b"}, "^give prompt or prompt_embedding, not both$"),
        ({"prompt": "a", "pretrained": None}, "^a prompt needs pretrained weights with a text encoder; give"),
        ({"prompt": "walk " * 9}, r"^the prompt has \d+ tokens, the transformer takes 10; shorten it$"),
        ({"prompt_embedding": "gone.safetensors"}, "gone.safetensors"),
    ],
)
def test_a_prompt_that_cannot_be_embedded_is_refused(folder, change, cause):
    with pytest.raises(CheckpointError, match=cause) as error:
        load_twin(folder, **change)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("part", ["text_encoder", "tokenizer"])
def test_a_prompt_without_its_encoder_is_refused_with_another_way_to_go(folder, tmp_path, part):
    shutil.copytree(folder, tmp_path / "twin")
    for file in (tmp_path / "twin" / part).glob("*.json"):
        file.write_text("{")
    with pytest.raises(CheckpointError, match=r"the text encoder cannot be loaded .*; give backbone.settings"):
        load_twin(tmp_path / "twin", prompt=PROMPT)
    shutil.rmtree(tmp_path / "twin" / part)
    with pytest.raises(CheckpointError, match=f"no {part}/ to embed the prompt 'a walk' with; give .* zeros$"):
        load_twin(tmp_path / "twin", prompt=PROMPT)


def test_embedding_a_prompt_never_uses_the_network(tmp_path, monkeypatch):
    hosts, name = [], "zai-org/CogVideoX-2b"
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr("socket.getaddrinfo", lambda host, *_, **__: hosts.append(host) or [])
    write_twin("2b", write_snapshot(tmp_path / "hub", name))
    assert not load_twin(name).prompt.any()
    with pytest.raises(CheckpointError, match=r"no text_encoder/ to embed the prompt 'a walk' with; give .* zeros$"):
        load_twin(name, prompt=PROMPT)
    assert hosts == []


def test_an_embedding_of_another_size_or_name_is_refused(folder, tmp_path):
    file = tmp_path / "other.safetensors"
    write_tensors(file, {"prompt": torch.zeros(1, 3, 8)})
    with pytest.raises(CheckpointError, match=r"embedding of \(1, 3, 8\), but the transformer takes \(1, 10, 8\)"):
        load_twin(folder, prompt_embedding=str(file))
    write_tensors(file, {"prompt": torch.full((1, 10, 8), torch.nan)})
    with pytest.raises(CheckpointError, match="with values that are no numbers; make it again"):
        load_twin(folder, prompt_embedding=str(file))
    write_tensors(file, {"text": torch.zeros(1, 10, 8)})
    with pytest.raises(CheckpointError, match=r"no tensor 'prompt' in it; persist_backbones.write_prompt"):
        load_twin(folder, prompt_embedding=str(file))


def test_a_base_keeps_its_prompt(folder, tmp_path):
    model = load_twin(folder, prompt=PROMPT)
    model.save_base(tmp_path)
    with torch.device("meta"):
        loaded = make_backbone("cogvideox", model.checkpoint_settings() | {"prompt_embedding": "x.safetensors"})
    with pytest.raises(CheckpointError, match="trained with a prompt of its own; leave prompt"):
        loaded.load_base(tmp_path)


def test_a_sentencepiece_model_says_which_packages_read_it(folder, tmp_path, monkeypatch):
    shutil.copytree(folder, tmp_path / "twin")
    (tmp_path / "twin" / "tokenizer" / "tokenizer.json").unlink()
    (tmp_path / "twin" / "tokenizer" / "spiece.model").write_bytes(b"\0")
    monkeypatch.setattr("transformers.utils.is_sentencepiece_available", lambda: False)
    with pytest.raises(CheckpointError, match=r"SentencePiece model; to read it: pip install 'persist-cli\[prompt\]'"):
        load_twin(tmp_path / "twin", prompt=PROMPT)
