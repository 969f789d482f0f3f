"""Video diffusion backbones: plugins of the entry point ``persist.backbones``, and pipelines of diffusers' kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from persist_backbones.pipeline import WorldPipeline
    from persist_cli.world.placement import Precision


def load(folder: Path | str, adapter: str | None = None, dtype: Precision | None = None) -> WorldPipeline:
    """A checkpoint as a pipeline of diffusers' kind, on the CPU and ready to sample.

    ``pipeline = persist_backbones.load("runs/voxel")``, then ``pipeline.to("cuda")`` or
    ``pipeline.enable_model_cpu_offload()``, and ``pipeline(image, depth, cameras, memory_tokens=tokens)``. The
    backbone itself is ``pipeline.backbone``.

    Args:
        folder: of a checkpoint or an export, or of a run, which stands for its newest checkpoint.
        adapter: of memory; by default the checkpoint's default or only one. ``stage1`` is the base without any.
        dtype: ``float32`` (by default), ``bfloat16`` or ``float16``.

    Raises:
        PersistError: one line when there is no such checkpoint or adapter, or it is damaged.
    """
    from persist_backbones.loading import load_pipeline  # diffusers takes seconds to import

    return load_pipeline(Path(folder), adapter, dtype)
