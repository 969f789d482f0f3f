"""diffusers' own tests of pipelines, run against ours on micro components.

They live in diffusers' repository and not in its wheel: ``DIFFUSERS_CHECKOUT`` names a checkout of v0.40 or later.

The class under test writes safetensors where a test asks for pickled weights, which we neither write nor read. These
tests do not apply either:

- FasterCache's denoiser: it skips a guidance whose two predictions are one batch, and hooks the forward of diffusers'
  transformer; ours predicts twice and runs the blocks itself. Its attention is cached, see ``test_caches``.
- Group offload: it hooks the forward of diffusers' transformer for modules outside the blocks, but ours does not run
  it; CPU offload of whole models and of layers works.
- ``encode_prompt`` and ``num_images_per_prompt``: the prompt is constant and stored; every clip has its own cameras.
- LoRA, IP adapters, quantization: diffusers' mixins for pipelines that load them; ours has no such loader.
- Tests for an accelerator skip themselves without one: half precision, offloading, device maps, layerwise casting.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from persist_backbones.pipeline.pipeline import WorldPipeline
from persist_cli.api.tokens import MemoryTokens
from tests.support.micro_model import micro, random_clips, random_tokens, shaken, with_adapter
from tests.support.micro_runs import MICRO

CHECKOUT = os.environ.get("DIFFUSERS_CHECKOUT")
NAME = "diffusers_tests"  # not ``tests``, which our package is called too

if not CHECKOUT:
    pytest.skip("DIFFUSERS_CHECKOUT names no checkout of diffusers' repository", allow_module_level=True)


def import_diffusers_tests(module: str) -> Any:
    """Import a module of diffusers' tests under the package name ``NAME``."""
    folder = Path(CHECKOUT or "") / "tests"
    if NAME not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            NAME, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        if spec is None or spec.loader is None or not (folder / "pipelines/testing_utils").is_dir():
            pytest.skip(f"{folder}: no diffusers v0.40 or later there", allow_module_level=True)
        sys.modules[NAME] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[NAME])
    return importlib.import_module(f"{NAME}.{module}")


mixins = import_diffusers_tests("pipelines.testing_utils")


class SafePipeline(WorldPipeline):
    """The pipeline, but it writes safetensors also when pickled weights are requested."""

    def save_pretrained(self, save_directory: Any, safe_serialization: bool = True, **options: Any) -> None:
        super().save_pretrained(save_directory, **options)


class MicroConfig(mixins.BasePipelineTesterConfig):  # type: ignore[misc,name-defined]
    """The description of the pipeline for diffusers' mixins."""

    pipeline_class = SafePipeline
    required_input_params_in_call_signature = frozenset(["image", "depth", "cameras"])
    batch_input_params = frozenset(["image", "depth", "cameras", "memory_tokens"])
    optional_input_params = frozenset(["num_inference_steps", "generator", "latents", "output_type", "return_dict"])
    callback_cfg_params = frozenset()
    output_shape = (9, 3, 32, 32)

    def get_dummy_components(self, num_layers: int = 2) -> dict[str, Any]:
        backbone = with_adapter(micro(transformer=MICRO["transformer"] | {"num_layers": num_layers}))
        shaken(backbone)
        return WorldPipeline.of(backbone).components

    def get_dummy_inputs(self) -> dict[str, Any]:
        clips = random_clips(1, random_tokens(1, 5))
        return {
            "image": clips.rgb[0, 0],
            "depth": clips.depth[0, 0],
            "cameras": clips.cameras[0],
            "memory_tokens": MemoryTokens.of(clips.tokens.features[0], clips.tokens.positions[0]),
            "num_inference_steps": 2,
            "guidance_scale": 1.5,
            "generator": self.get_generator(0),
            "output_type": "pt",
        }


class UnguidedConfig(MicroConfig):
    """The pipeline without guidance, for tests of caches that expect one prediction a step."""

    def get_dummy_inputs(self) -> dict[str, Any]:
        return super().get_dummy_inputs() | {"guidance_scale": 1.0}


class TestPipeline(MicroConfig, mixins.PipelineTesterMixin):  # type: ignore[misc,name-defined]
    """Saving and loading, variants, dtypes, batches, callbacks, guidance."""


class TestOffload(MicroConfig, mixins.PipelineOffloadTesterMixin):  # type: ignore[misc,name-defined]
    """Offloading of models and of layers, device maps; on an accelerator."""


class TestLayerwiseCasting(MicroConfig, mixins.LayerwiseCastingTesterMixin):  # type: ignore[misc,name-defined]
    """Weights kept in eight bits."""


class TestFirstBlockCache(MicroConfig, mixins.FirstBlockCacheTesterMixin):  # type: ignore[misc,name-defined]
    """First-block cache."""


class TestTaylorSeer(MicroConfig, mixins.TaylorSeerCacheTesterMixin):  # type: ignore[misc,name-defined]
    """TaylorSeer, lite."""


class TestMagCache(MicroConfig, mixins.MagCacheTesterMixin):  # type: ignore[misc,name-defined]
    """MagCache."""


class TestPyramidAttention(UnguidedConfig, mixins.PyramidAttentionBroadcastTesterMixin):  # type: ignore[misc,name-defined]
    """Pyramid attention broadcast."""


class TestFasterCache(UnguidedConfig, mixins.FasterCacheTesterMixin):  # type: ignore[misc,name-defined]
    """FasterCache's attention."""

    FASTER_CACHE_CONFIG = {  # noqa: RUF012
        **mixins.FasterCacheTesterMixin.FASTER_CACHE_CONFIG,
        "is_guidance_distilled": True,
    }

    def test_faster_cache_state(self) -> None:
        pytest.skip("the hooked forward of diffusers' transformer is not run: its blocks are, with memory between")
