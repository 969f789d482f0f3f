"""The memory adapters of a backbone: added, chosen, saved and loaded, and given the memory of a batch."""

from __future__ import annotations

import dataclasses
import json
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, AdapterCondition, MemoryCondition, VideoShape
from persist_backbones.adapters.forms import adapter_settings, load_adapter, make_adapter, save_adapter
from persist_backbones.cogvideox.codec import Codec
from persist_backbones.cogvideox.model import NO_MEMORY
from persist_backbones.noise_levels import draw_levels
from persist_cli.api.backbone import Backbone, Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_cli.io.setting_docs import Setting


class AdaptedBackbone(Backbone):
    """A backbone with memory adapters, of which one or none is in use.

    Args:
        settings: an instance of ``settings_type``.
    """

    codec: Codec

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.adapters = nn.ModuleDict()
        self.adapter_name: str | None = None

    @property
    @abstractmethod
    def video_shape(self) -> VideoShape:
        """The sizes of the model that an adapter is built for."""

    @property
    def adapter(self) -> Adapter[Any] | None:
        """The memory adapter in use, ``None`` without one."""
        return None if self.adapter_name is None else self.adapters[self.adapter_name]  # type: ignore[return-value]

    @property
    def token_budget(self) -> int:
        """Largest number of tokens that the adapter in use takes for a clip; 0 without an adapter."""
        return self.adapter.settings.token_budget if self.adapter else 0

    @property
    def reads_frames(self) -> bool:
        """Whether the adapter in use reads whole frames."""
        return self.adapter is not None and self.adapter.reads_frames

    @property
    def draws_tokens(self) -> bool:
        """Whether the adapter in use draws tokens into the views of a clip."""
        return self.adapter is not None and self.adapter.draws_tokens

    def count_tokens(self, tokens: MemoryTokens, cameras: Cameras) -> int:
        """Return how many tokens the adapter in use makes of one sample's memory tokens."""
        return super().count_tokens(tokens, cameras) if self.adapter is None else self.adapter.count(tokens, cameras)

    def memory_condition(
        self, clips: Clips, generators: list[torch.Generator] | None = None, level: Tensor | None = None
    ) -> MemoryCondition:
        """Embed the batch's tokens with the adapter in use; without an adapter there is no memory.

        Args:
            clips: the batch; without tokens its memory is empty.
            generators: generators that draw, for training, noise and which samples see no memory.
            level: noise level that each sample's memory is declared to have, in sampling; ``None`` for 0.

        Raises:
            CheckpointError: when the tokens do not come from the encoder that the adapter was trained with.
        """
        adapter = self.adapter
        if adapter is None:
            return NO_MEMORY
        tokens = clips.tokens
        if tokens is None:
            tokens = MemoryTokens.stack([MemoryTokens.empty(adapter.channels)] * len(clips.seeds))
        if tokens.features.shape[-1] != adapter.channels:
            raise CheckpointError(
                f"the memory gives features of {tokens.features.shape[-1]} channels, adapter {self.adapter_name!r} was "
                f"trained with {adapter.channels}; use the encoder it was trained with"
            )
        cameras = clips.cameras.to(self.device)
        with torch.no_grad():
            tokens = adapter.render(tokens.to(self.device), cameras, self.codec.encode)
        if generators is not None and adapter.settings.noise:
            level = draw_levels(generators, adapter.settings.noise)
            tokens = adapter.noisy(tokens, level.to(self.device), generators)
        memory = adapter.prepare(tokens, cameras)
        if level is not None and adapter.settings.noise:
            known = level.clamp(max=adapter.settings.noise)  # a higher one it has never been told
            memory = dataclasses.replace(memory, level=known.to(self.device))
        return AdapterCondition(adapter, memory if generators is None else adapter.dropped(memory, generators))

    @torch.no_grad()
    def keep_tokens(self, clips: Clips) -> MemoryTokens:
        """Return what the adapter in use needs of the clips' tokens: the encoded views of a memory that it renders."""
        tokens, adapter = super().keep_tokens(clips), self.adapter
        if adapter is None:
            return tokens
        return adapter.render(tokens.to(self.device), clips.cameras.to(self.device), self.codec.encode)

    def token_encoding(self) -> str:
        """Return what ``keep_tokens`` depends on: the codec, and the adapter's settings of rendering."""
        settings = None if self.adapter is None else self.adapter.rendering()
        return "" if settings is None else json.dumps({"codec": self.encoding()} | dict(settings), sort_keys=True)

    @classmethod
    def adapter_settings(cls, chosen: Mapping[str, Any]) -> list[Setting]:
        """Return the settings of the form and preset that are chosen."""
        return adapter_settings(chosen)

    def add_adapter(self, name: str, channels: int, settings: Mapping[str, Any]) -> None:
        """Add a fresh memory adapter and use it."""
        self._take_adapter(name, make_adapter(channels, settings, self.video_shape, f"adapter {name!r}"))

    def use_adapter(self, name: str | None) -> None:
        """Use one of the adapters, or none: plain stage 1."""
        if name is not None and name not in self.adapters:
            raise CheckpointError(f"no memory adapter {name!r}; there are: {', '.join(self.adapters) or 'none'}")
        self.adapter_name = name

    def save_adapter(self, folder: Path) -> None:
        """Write the memory adapter in use."""
        if self.adapter is None:
            raise CheckpointError("no memory adapter is in use, so none can be saved")
        save_adapter(self.adapter, folder)

    def load_adapter(self, name: str, folder: Path) -> None:
        """Add the adapter that ``save_adapter`` wrote, and use it."""
        self._take_adapter(name, load_adapter(folder, self.video_shape))

    def _take_adapter(self, name: str, adapter: Adapter[Any]) -> None:
        height, width = (side // self.codec.spatial for side in self.image_size)
        adapter.check_latents(height, width)
        self.adapters[name] = adapter.to(self.device)
        self.adapter_name = name
