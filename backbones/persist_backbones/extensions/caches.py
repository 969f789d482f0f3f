"""diffusers' caches over the denoising steps of a clip, with memory blocks between the cached blocks.

diffusers puts hooks on the blocks of its transformer (``enable_cache``). The hooks do not know three things that this
module adds: memory blocks between the blocks, a second output layer, and steps that predict with and without memory.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

from diffusers.hooks import (
    FasterCacheConfig,
    FirstBlockCacheConfig,
    HookRegistry,
    MagCacheConfig,
    PyramidAttentionBroadcastConfig,
    TaylorSeerCacheConfig,
    apply_taylorseer_cache,
)
from diffusers.hooks.taylorseer_cache import _TAYLORSEER_CACHE_HOOK, TaylorSeerState
from diffusers.models.cache_utils import CacheMixin
from torch import Tensor, nn

from persist_backbones.adapters.base import MemoryCondition, NoiseLevel
from persist_backbones.cogvideox.model import Conditions, WorldTransformer
from persist_cli.errors import PersistError

CACHES = (
    FirstBlockCacheConfig, TaylorSeerCacheConfig, MagCacheConfig, PyramidAttentionBroadcastConfig, FasterCacheConfig,
)  # fmt: skip
ATTENTION = r"transformer_blocks\.\d+\.attn1"


def enable_cache(transformer: WorldTransformer, config: Any) -> None:
    """Skip work that changes little between denoising steps, with one of diffusers' caches.

    For example ``enable_cache(backbone.transformer, FirstBlockCacheConfig(threshold=0.1))``;
    ``transformer.base.disable_cache()`` computes everything again. A cache that needs the timestep
    (``current_timestep_callback``) and has no callback gets the timestep of the sampling.

    Raises:
        PersistError: for a cache that does not work with this transformer.
    """
    check_cache(config)
    if getattr(config, "current_timestep_callback", transformer) is None:
        config.current_timestep_callback = lambda: getattr(transformer, "timestep", 0)
    transformer.base.enable_cache(_with_layers(config))


def check_cache(config: Any) -> None:
    """Raise ``PersistError`` for a cache that does not work with two outputs and two predictions a step."""
    if not isinstance(config, CACHES):
        known = ", ".join(kind.__name__ for kind in CACHES)
        raise PersistError(f"{type(config).__name__} does not work with this transformer; known: {known}")
    if isinstance(config, FasterCacheConfig) and not config.is_guidance_distilled:
        raise PersistError(
            "FasterCacheConfig skips a guidance whose two predictions are one batch, and memory's are not; give it "
            "is_guidance_distilled=True"
        )


def _with_layers(config: Any) -> Any:
    """Name CogVideoX's layers in a configuration of TaylorSeer, whose default names fit none of them."""
    if not isinstance(config, TaylorSeerCacheConfig) or config.use_lite_mode:
        return config
    if config.cache_identifiers or config.skip_predict_identifiers:
        return config
    return dataclasses.replace(config, cache_identifiers=[ATTENTION])


class ClipCaches:
    """The caches while one clip is sampled: empty at first, and separate for the predictions of one step.

    Args:
        transformer: the transformer; its base may have a cache enabled.

    Raises:
        PersistError: when that cache does not work with this transformer.
    """

    def __init__(self, transformer: WorldTransformer) -> None:
        self.transformer = transformer
        self.hooks = [hook for module in transformer.modules() for hook in _hooks_of(module)]
        self.states: dict[tuple[Any, str], Any] = {}  # of caches without contexts
        config = transformer.base._cache_config
        if config is not None:
            check_cache(config)
            if not self.hooks:
                raise PersistError(f"{type(config).__name__} fits no layer; attention is {ATTENTION!r} here")
        if self.hooks:
            self._begin(config)

    def _begin(self, config: Any) -> None:
        base, second = self.transformer.base, HookRegistry.check_if_exists_or_initialize(self.transformer.extra_out)
        second.remove_hook(_TAYLORSEER_CACHE_HOOK)
        if any(_TAYLORSEER_CACHE_HOOK in registry.hooks for registry in _registries_of(base.proj_out)):
            changes = {"use_lite_mode": False, "cache_identifiers": ["extra_out"], "skip_predict_identifiers": None}
            apply_taylorseer_cache(self.transformer, dataclasses.replace(config, **changes))
        self.transformer.__dict__.pop("_diffusers_hook", None)  # it remembers which parts had hooks
        self.forget()

    def forget(self) -> None:
        """Empty the caches."""
        CacheMixin._reset_stateful_cache(self.transformer)

    def around(self, conditions: Conditions) -> Conditions:
        """Return conditions whose memory is skipped between blocks that a cache replaces."""
        if not self.hooks:
            return conditions
        blocks = self.transformer.base.transformer_blocks
        return dataclasses.replace(conditions, memory=SkippedMemory(conditions.memory, blocks))

    @contextlib.contextmanager
    def prediction(self, name: str, conditions: Conditions) -> Iterator[None]:
        """Within the block, the transformer uses the caches of the prediction ``name``.

        Args:
            name: name of one of the predictions that every step makes.
            conditions: conditions with the timestep of the step.
        """
        if not self.hooks:
            yield
            return
        self.transformer.timestep = int(conditions.timestep[0])  # type: ignore[assignment]
        for hook in self.hooks:
            if hasattr(hook, "state"):
                hook.state = self.states.setdefault((hook, name), type(hook.state)())
        with CacheMixin.cache_context(self.transformer, name):
            yield


def _hooks_of(module: nn.Module) -> list[Any]:
    """Return the hooks that diffusers put on the module itself."""
    return [hook for registry in _registries_of(module) for hook in registry.hooks.values()]


def _registries_of(module: nn.Module) -> list[Any]:
    """Return the registry of the module's hooks in a list, or an empty list."""
    registry = getattr(module, "_diffusers_hook", None)
    return [] if registry is None else [registry]


@dataclasses.dataclass(frozen=True)
class SkippedMemory(MemoryCondition):
    """A memory that is not used between blocks whose output comes from a cache.

    Args:
        memory: the memory, used where blocks are computed.
        blocks: the blocks of diffusers' transformer.
    """

    memory: MemoryCondition
    blocks: nn.ModuleList

    def time(self, time: Tensor) -> Tensor:
        """Return the time embedding with that of the memory's noise level."""
        return self.memory.time(time)

    def begin(self, video: Tensor) -> Tensor:
        """Return the embedded video tokens, before the first transformer block."""
        return self.memory.begin(video)

    def before(self, layer: int, video: Tensor) -> Tensor:
        """Return the input of transformer block ``layer``."""
        if layer and _rest_is_cached(self.blocks[0]):
            return video
        return self.memory.before(layer, video)

    def after(self, layer: int, video: Tensor, camera: Tensor, time: Tensor) -> Tensor:
        """Return the hidden states after transformer block ``layer``."""
        if layer < len(self.blocks) - 1 and _rest_is_cached(self.blocks[0]):
            return video
        return self.memory.after(layer, video, camera, time)

    def correct(self, predicted: Tensor, inputs: Tensor, time: Tensor, level: NoiseLevel) -> Tensor:
        """Return the prediction, corrected by the memory."""
        return self.memory.correct(predicted, inputs, time, level)


def _rest_is_cached(block: nn.Module) -> bool:
    """Whether the first block's output, from a cache, contains the change by all other blocks and their memory."""
    registry = getattr(block, "_diffusers_hook", None)
    hooks = registry.hooks.values() if registry is not None else ()
    return any(_skips(hook.state_manager.get_state()) for hook in hooks if hasattr(hook, "state_manager"))


def _skips(state: Any) -> bool:
    if isinstance(state, TaylorSeerState):
        return bool(state.is_inactive and state.last_update_step != state.current_step)
    return not getattr(state, "should_compute", True)
