"""The prompt's embedding: computed once with T5 where its weights are, read from a file, or zeros.

A world model is asked with one prompt, so its embedding is stored with the checkpoint and nobody else needs T5.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.parts import pretrained_folder
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_json, read_tensors, reallocate, write_tensors
from persist_cli.io.hub import without_bars

ORIGINS = ("pretrained", "prompt", "prompt_embedding")  # settings of a model's beginning: a checkpoint holds the rest

NAME = "prompt"  # of the tensor in files

OTHERWISE = "give backbone.settings.prompt_embedding a file, or leave the prompt out: zeros"


def check_choice(settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the settings name two prompts, or one that nothing can embed."""
    if settings.prompt is not None and settings.prompt_embedding is not None:
        raise CheckpointError("give prompt or prompt_embedding, not both")
    if settings.prompt is not None and settings.pretrained is None:
        raise CheckpointError(f"a prompt needs pretrained weights with a text encoder; {OTHERWISE}")


def starting_prompt(
    settings: CogVideoXSettings, zeros: Float[Tensor, "1 word channel"]
) -> Float[Tensor, "1 word channel"]:
    """The embedding that the settings choose.

    Args:
        settings: with a prompt, a file, or neither.
        zeros: what it is without either; a plan's is that in any case.

    Raises:
        CheckpointError: one line when T5 is not here, or an embedding is not of the transformer's size.
    """
    check_choice(settings)
    if zeros.is_meta or (settings.prompt is None and settings.prompt_embedding is None):
        return zeros
    if settings.prompt_embedding is not None:
        source, found = settings.prompt_embedding, read_prompt(Path(settings.prompt_embedding))
    else:
        source = str(settings.pretrained)
        found = embed_prompt(str(settings.prompt), pretrained_folder(source), zeros.shape[1])
    if found.shape != zeros.shape:
        raise CheckpointError(
            f"{source}: a prompt's embedding of {tuple(found.shape)}, but the transformer takes {tuple(zeros.shape)}"
        )
    if not found.isfinite().all():
        raise CheckpointError(f"{source}: a prompt's embedding with values that are no numbers; make it again")
    return found.to(zeros)


def read_prompt(path: Path) -> Float[Tensor, "1 word channel"]:
    """The tensor ``prompt`` of a safetensors file: one of ``write_prompt``, or a checkpoint's ``world.safetensors``."""
    tensors, _ = read_tensors(path)
    if NAME not in tensors:
        raise CheckpointError(f"{path}: no tensor {NAME!r} in it; persist_backbones.write_prompt makes one")
    return tensors[NAME]


def save_prompt(prompt: str, pretrained: str, path: Path) -> None:
    """See ``persist_backbones.write_prompt``."""
    folder = pretrained_folder(pretrained)
    words = read_json(folder / "transformer" / "config.json")["max_text_seq_length"]
    write_tensors(path, {NAME: embed_prompt(prompt, folder, words)})


@torch.no_grad()
def embed_prompt(prompt: str, folder: Path, words: int) -> Float[Tensor, "1 word channel"]:
    """T5's last hidden states of a prompt, padded as CogVideoX was trained, float32.

    Args:
        prompt: text; the empty one is a prompt too.
        folder: with ``text_encoder/`` and ``tokenizer/`` in safetensors; nothing is downloaded.
        words: tokens that the transformer takes.

    Raises:
        CheckpointError: one line when one of them is missing or unusable, and for a longer prompt.
    """
    from transformers import T5EncoderModel, T5Tokenizer

    for name in ("text_encoder", "tokenizer"):
        if not (folder / name).is_dir():
            raise CheckpointError(f"{folder}: no {name}/ to embed the prompt with; {OTHERWISE}")
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
    reallocate(encoder)
    tokens = tokenizer(prompt, padding="max_length", max_length=words, return_tensors="pt").input_ids
    if tokens.shape[1] > words:
        raise CheckpointError(f"the prompt has {tokens.shape[1]} tokens, the transformer takes {words}; shorten it")
    embedding: Tensor = encoder(tokens)[0]
    return embedding.float()


def _check_tokenizer(folder: Path) -> None:
    """Say which packages a tokenizer needs that is a SentencePiece model alone, as the published ones are."""
    from transformers.utils import is_protobuf_available, is_sentencepiece_available

    readable = is_sentencepiece_available() and is_protobuf_available()
    if not readable and not (folder / "tokenizer.json").is_file():
        raise CheckpointError(f"{folder}: a SentencePiece model; to read it: pip install 'persist-cli[prompt]'")
