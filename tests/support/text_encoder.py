"""A small T5 with its tokenizer, as the folders of a diffusers directory."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from tokenizers import Tokenizer, models, pre_tokenizers, trainers
from transformers import T5Config, T5EncoderModel, T5Tokenizer

SPECIAL = ["<pad>", "</s>", "<unk>"]


def small_tokenizer() -> T5Tokenizer:
    """A unigram tokenizer, trained on one line of text."""
    unigram = Tokenizer(models.Unigram())
    unigram.pre_tokenizer = pre_tokenizers.Metaspace()
    trainer = trainers.UnigramTrainer(vocab_size=40, special_tokens=SPECIAL, unk_token="<unk>", show_progress=False)
    unigram.train_from_iterator(["a walk through a furnished house, a walk back"] * 4, trainer)
    vocabulary = [(piece, score) for piece, score in json.loads(unigram.to_str())["model"]["vocab"]]
    return T5Tokenizer(vocab=vocabulary, extra_ids=0)


def write_text_encoder(folder: Path) -> Path:
    """Write ``tokenizer/`` and ``text_encoder/`` into a twin as diffusers saves them, and return the folder."""
    tokenizer = small_tokenizer()
    tokenizer.save_pretrained(folder / "tokenizer")
    torch.manual_seed(1)
    sizes = {"d_model": 8, "d_ff": 16, "d_kv": 4, "num_heads": 2, "num_layers": 1}
    T5EncoderModel(T5Config(**sizes, vocab_size=len(tokenizer))).save_pretrained(folder / "text_encoder")
    return folder
