"""Video diffusion backbones: plugins of the entry point ``persist.backbones``, and pipelines of diffusers' kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from persist_cli.io.checksums import verifying

if TYPE_CHECKING:
    from persist_backbones.pipeline.pipeline import WorldPipeline
    from persist_cli.api.inference import Precision


def load(
    folder: Path | str, adapter: str | None = None, dtype: Precision | None = None, verify: bool = False
) -> WorldPipeline:
    """Load a checkpoint as a pipeline of diffusers' kind, on the CPU and ready to sample.

    ``pipeline = persist_backbones.load("runs/voxel")``, then ``pipeline.to("cuda")`` or
    ``pipeline.enable_model_cpu_offload()``, and ``pipeline(image, depth, cameras, memory_tokens=tokens)``. The
    backbone itself is ``pipeline.backbone``.

    Args:
        folder: folder of a checkpoint, of an export, or of a run, whose newest checkpoint is loaded.
        adapter: name of a memory adapter, by default the checkpoint's default or only one; ``stage1`` for no adapter.
        dtype: precision of the weights: ``float32`` (by default), ``bfloat16`` or ``float16``.
        verify: whether large files are verified by their checksums too; those of up to 256 MiB always are.

    Raises:
        PersistError: one line when there is no such checkpoint or adapter, or it is damaged.
    """
    import torch

    from persist_backbones.pipeline.pipeline import load_pipeline  # diffusers takes seconds to import

    with verifying(verify), torch.random.fork_rng(devices=[]):  # parts are drawn before they are loaded
        return load_pipeline(Path(folder), adapter, dtype)


def write_prompt(prompt: str, pretrained: str, path: Path | str) -> None:
    """Write a prompt's embedding for ``backbone.settings.prompt_embedding``, on a machine that has the text encoder.

    Args:
        prompt: the text.
        pretrained: a diffusers CogVideoX directory with ``text_encoder/`` and ``tokenizer/``.
        path: the safetensors file that is written.

    Raises:
        PersistError: one line when T5 is missing or unusable, or the prompt is too long.
    """
    from persist_backbones.cogvideox.prompt import save_prompt  # transformers takes seconds to import

    save_prompt(prompt, pretrained, Path(path))
