"""The prompt's embedding: computed once by T5, read from a file, or zeros.

A world model has one constant prompt. Its embedding is stored with the checkpoint, so that its users do not need T5.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.parts import WORLD, load_part, pretrained_folder
from persist_cli.api.half_precision import is_slow
from persist_cli.api.meta_device import without_weights
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors, reallocate, write_tensors
from persist_cli.io.hub import without_bars

ORIGINS = ("pretrained", "prompt", "prompt_embedding")  # settings that a checkpoint replaces by weights
NAME = "prompt"  # of the tensor in files
OTHERWISE = "give backbone.settings.prompt_embedding a file, or backbone.settings.prompt=null for zeros"


def check_choice(settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` for settings with two prompts, or with a prompt but no text encoder."""
    if settings.prompt and settings.prompt_embedding is not None:
        raise CheckpointError("give prompt or prompt_embedding, not both")
    if settings.prompt and settings.pretrained is None:
        raise CheckpointError(f"a prompt needs pretrained weights with a text encoder; {OTHERWISE}")


def starting_prompt(
    settings: CogVideoXSettings, zeros: Float[Tensor, "1 word channel"]
) -> Float[Tensor, "1 word channel"]:
    """Return the embedding of the prompt that the settings choose.

    Args:
        settings: settings with a prompt, an embedding's file, or neither.
        zeros: the embedding of no prompt, and in any case on the meta device and of a model that knows no text.

    Raises:
        CheckpointError: one line when T5 is missing, or the embedding does not have the transformer's size.
    """
    check_choice(settings)
    text = settings.prompt if settings.pretrained is not None else None
    if zeros.is_meta or (text is None and settings.prompt_embedding is None):
        return zeros
    if settings.prompt_embedding is not None:
        source, embedding = settings.prompt_embedding, read_prompt(Path(settings.prompt_embedding))
    else:
        source = str(settings.pretrained)
        embedding = embed_prompt(str(text), pretrained_folder(source), zeros.shape[1])
    size, wanted = tuple(embedding.shape), tuple(zeros.shape)
    if size != wanted:
        raise CheckpointError(f"{source}: a prompt's embedding of {size}, but the transformer takes {wanted}")
    if not embedding.isfinite().all():
        raise CheckpointError(f"{source}: a prompt's embedding with values that are no numbers; make it again")
    return embedding.to(zeros)


def read_prompt(path: Path) -> Float[Tensor, "1 word channel"]:
    """Read the tensor ``prompt`` of a file of ``write_prompt``, or of a checkpoint's ``world.safetensors``."""
    tensors, _ = read_tensors(path)
    if NAME not in tensors:
        raise CheckpointError(f"{path}: no tensor {NAME!r} in it; persist_backbones.write_prompt makes one")
    return tensors[NAME]


def computed_prompt(settings: CogVideoXSettings, folder: Path, begun: Path | None) -> dict[str, Any]:
    """Return settings that name the file of an embedding in the place of a prompt that T5 would embed; else none.

    Args:
        settings: settings with a prompt, an embedding's file, or neither.
        folder: the folder that ``prompt.safetensors`` is written into.
        begun: the folder of a trained model, whose own prompt is taken; ``None`` asks T5.

    Raises:
        CheckpointError: as ``starting_prompt`` does.
    """
    check_choice(settings)
    if settings.pretrained is None or settings.prompt is None or settings.prompt_embedding is not None:
        return {}
    path = folder / "prompt.safetensors" if begun is None else begun / WORLD
    if begun is None:
        save_prompt(settings.prompt, settings.pretrained, path)
    return {"prompt": None, "prompt_embedding": str(path)}


def save_prompt(prompt: str, pretrained: str, path: Path) -> None:
    """Write a prompt's embedding into a safetensors file; see ``persist_backbones.write_prompt``."""
    folder = pretrained_folder(pretrained)
    with without_weights():
        words = load_part(folder, "transformer").config.max_text_seq_length
    write_tensors(path, {NAME: embed_prompt(prompt, folder, words)})


@torch.no_grad()
def embed_prompt(prompt: str, folder: Path, words: int) -> Float[Tensor, "1 word channel"]:
    """Return T5's last hidden states of a prompt, padded like in CogVideoX's training, float32.

    Args:
        prompt: the text, which may be empty.
        folder: folder with ``text_encoder/`` and ``tokenizer/``, weights as safetensors; nothing is downloaded.
        words: number of text tokens that the transformer takes.

    Raises:
        CheckpointError: one line when encoder or tokenizer is missing or unusable, and for a prompt that is too long.
    """
    from transformers import T5EncoderModel, T5Tokenizer

    for name in ("text_encoder", "tokenizer"):
        if not (folder / name).is_dir():
            raise CheckpointError(f"{folder}: no {name}/ to embed the prompt {prompt!r} with; {OTHERWISE}")
    _check_tokenizer(folder / "tokenizer")
    try:
        tokenizer = T5Tokenizer.from_pretrained(folder / "tokenizer", local_files_only=True)
        with without_bars():
            encoder = T5EncoderModel.from_pretrained(
                folder / "text_encoder", local_files_only=True, use_safetensors=True, dtype="auto"
            )
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, ImportError) as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{folder}: the text encoder cannot be loaded ({cause}); {OTHERWISE}") from error
    if is_slow(encoder.dtype):
        encoder.float()
    reallocate(encoder)
    tokens = tokenizer(prompt, padding="max_length", max_length=words, return_tensors="pt").input_ids
    if tokens.shape[1] > words:
        raise CheckpointError(f"the prompt has {tokens.shape[1]} tokens, the transformer takes {words}; shorten it")
    embedding: Tensor = encoder(tokens)[0]
    return embedding.float()


def _check_tokenizer(folder: Path) -> None:
    """Raise ``CheckpointError`` if packages are missing that read a tokenizer which is only a SentencePiece model."""
    from transformers.utils import is_protobuf_available, is_sentencepiece_available

    readable = is_sentencepiece_available() and is_protobuf_available()
    if not readable and not (folder / "tokenizer.json").is_file():
        raise CheckpointError(f"{folder}: a SentencePiece model; to read it: pip install 'persist-cli[prompt]'")
