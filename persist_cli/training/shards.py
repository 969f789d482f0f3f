"""Tensors of which every process holds a part: one safetensors file a process, read by any number of them.

The files are those of ``torch.distributed.checkpoint``'s Hugging Face storage: each says where its parts stand.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from torch import Tensor
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader, HuggingFaceStorageWriter
from torch.distributed.checkpoint.metadata import TensorStorageMetadata
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from persist_cli.world.errors import CheckpointError


def write_shards(folder: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write this process's parts into a folder; all processes must call it with the same names.

    Raises:
        OSError: on every process, naming those that could not write.
    """
    try:
        save(dict(tensors), storage_writer=HuggingFaceStorageWriter(str(folder), save_distributed=True))
    except CheckpointException as error:
        raise OSError(_causes(error)) from error


def read_shards(folder: Path, like: Callable[[str, torch.Size, torch.dtype], Tensor]) -> dict[str, Tensor]:
    """Read the parts that this process needs of every tensor.

    Args:
        folder: with files of ``write_shards``, or a single file of whole tensors.
        like: a tensor to read into for each name, shape and type; a sharded one takes its part.

    Raises:
        CheckpointError: one line when a file is not whole.
    """
    try:
        reader = HuggingFaceStorageReader(str(folder))
        stored = reader.read_metadata().state_dict_metadata
        tensors = {
            name: like(name, each.size, each.properties.dtype)
            for name, each in stored.items()
            if isinstance(each, TensorStorageMetadata)
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that no process waits for another is what is meant here
            load(tensors, storage_reader=HuggingFaceStorageReader(str(folder)), no_dist=True)
    except CheckpointException as error:
        raise CheckpointError(f"{folder}: its parts cannot be read ({_causes(error)})") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{folder}: its parts cannot be read ({str(error).splitlines()[0]})") from error
    return tensors


def _causes(error: CheckpointException) -> str:
    """What went wrong on which process, in one line."""
    causes = {process: str(cause).splitlines() for process, (cause, _) in error.failures.items()}
    return "; ".join(f"process {process}: {lines[0] if lines else '?'}" for process, lines in sorted(causes.items()))
