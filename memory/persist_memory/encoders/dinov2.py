"""DINOv2 patch features (PEWM, memory), from fetched weights, a local directory or the hub."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float, UInt8
from pydantic import PositiveInt
from safetensors import SafetensorError
from torch import Tensor

from persist_cli.api.encoder import Encoder
from persist_cli.errors import CheckpointError
from persist_cli.io.files import reallocate
from persist_cli.io.hub import cached_weight, hub_obstacle, in_hub_cache, without_bars

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
WIDTHS = {"dinov2-small": 384, "dinov2-base": 768, "dinov2-s-derived": 384}  # channels of weights known by name
PUBLISHER = "facebook/"  # the names of the first two on the hub begin with it
_LOADING_ERRORS = (OSError, ValueError, RuntimeError, SafetensorError)


@dataclass(frozen=True)
class DinoV2Settings:
    """The weights and the block of the network that give the features.

    Args:
        weights: a directory that transformers wrote (``config.json`` and ``model.safetensors``); the name of weights
            that ``persist weights fetch`` brought (``dinov2-small``, ``dinov2-base``, ``dinov2-s-derived``); or a hub
            id, which is downloaded when it is not in the hub's cache. Missing weights are never replaced by others.
        size: pixels of the image's longer side when it is encoded; ``None`` keeps the size of the image. Both sides
            are then rounded to whole patches.
        layer: the block whose output is taken, counted from 1; ``None`` for the last. The final layer norm
            follows in either case. DINOv2-S-derived was tuned for another task in its last blocks: take its block 8.
        batch: frames encoded at once. More is faster on a GPU, but then the last bits of a feature depend on
            the frames beside it, and those of a map on how its frames were grouped.
        precision: type that the network computes in; features are float32 in either case.
    """

    weights: str = "dinov2-small"
    size: PositiveInt | None = None
    layer: PositiveInt | None = None
    batch: PositiveInt = 1
    precision: Literal["float32", "bf16"] = "float32"


class DinoV2(Encoder):
    """Features of a frozen DINOv2; its files are opened when first needed."""

    settings_type = DinoV2Settings
    settings: DinoV2Settings

    def __init__(self, settings: DinoV2Settings) -> None:
        super().__init__(settings)
        self._device = torch.device("cpu")

    @property
    def channels(self) -> int:
        """Width of the model.

        Raises:
            CheckpointError: when its configuration cannot be loaded.
        """
        return int(self._config.hidden_size)

    @property
    def channels_by_name(self) -> int:
        """Width of the model, also of weights known by name that are not fetched yet."""
        weights = self.settings.weights
        width = None if Path(weights).is_dir() else WIDTHS.get(weights.removeprefix(PUBLISHER))
        return self.channels if width is None else width

    def to(self, device: torch.device | str) -> DinoV2:
        """Encode on ``device`` from now on."""
        self._device = torch.device(device)
        return self

    @torch.no_grad()
    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return the normalised patch features of the chosen block, without class and register tokens."""
        model = self._model.to(self._device)
        rows, columns = self._rows_and_columns(rgb.shape[1], rgb.shape[2])
        parts = []
        for part in torch.split(rgb, self.settings.batch):
            pixels = self._pixels(part.to(self._device), rows, columns)
            with self._autocast():
                states = model(pixels).last_hidden_state
            parts.append(states[:, -rows * columns :].reshape(len(part), rows, columns, -1).float())
        return torch.cat(parts)

    def _autocast(self) -> AbstractContextManager[Any]:
        if self.settings.precision == "float32":
            return nullcontext()
        return torch.autocast(self._device.type, torch.bfloat16)

    @cached_property
    def _config(self) -> Any:
        from transformers import Dinov2Config

        config = self._from_pretrained(Dinov2Config)
        if self.settings.layer is not None and self.settings.layer > config.num_hidden_layers:
            raise CheckpointError(
                f"{self.settings.weights}: it has {config.num_hidden_layers} blocks, no block {self.settings.layer}"
            )
        return config

    @cached_property
    def _model(self) -> Any:
        from transformers import Dinov2Model

        options = {"use_safetensors": True, "config": self._config, "dtype": torch.float32}
        model = self._from_pretrained(Dinov2Model, **options).eval().requires_grad_(False)
        reallocate(model)
        del model.encoder.layer[self.settings.layer or len(model.encoder.layer) :]  # their output is not used
        return model

    def _from_pretrained(self, kind: Any, **options: Any) -> Any:
        source, local = self._source
        try:
            with without_bars():
                return kind.from_pretrained(source, local_files_only=local, **options)
        except _LOADING_ERRORS as error:
            cause = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise self._unavailable(f"{source} failed ({cause})") from error

    @cached_property
    def _source(self) -> tuple[str, bool]:
        """The argument of ``from_pretrained``, and whether it is on this machine already."""
        weights = self.settings.weights
        if Path(weights).is_dir():
            return weights, True
        if "/" not in weights:
            folder = cached_weight(weights)
            if folder is None:
                raise self._unavailable(f"not here: persist weights fetch {weights}")
            return str(folder), True
        if weights.count("/") > 1:
            raise self._unavailable("no such directory")
        if in_hub_cache(weights):
            return weights, True
        obstacle = hub_obstacle()
        if obstacle:
            raise self._unavailable(f"no such directory, not in the hub's cache, and the hub: {obstacle}")
        return weights, False

    def _unavailable(self, cause: str) -> CheckpointError:
        hint = "set encoder.weights to a directory or to fetched weights (persist weights list), or take 'patches'"
        return CheckpointError(f"DINOv2 weights {self.settings.weights!r}: {cause}; {hint}")

    def _rows_and_columns(self, height: int, width: int) -> tuple[int, int]:
        scale = (self.settings.size or max(height, width)) / max(height, width)
        patch = self._config.patch_size
        return max(1, math.floor(height * scale / patch + 0.5)), max(1, math.floor(width * scale / patch + 0.5))

    def _pixels(self, rgb: Tensor, rows: int, columns: int) -> Float[Tensor, "frame 3 height width"]:
        patch = self._config.patch_size
        image = rgb.permute(0, 3, 1, 2).float() / 255
        size = (rows * patch, columns * patch)
        image = torch.nn.functional.interpolate(image, size=size, mode="bicubic", antialias=True, align_corners=False)
        mean, std = (image.new_tensor(values)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD))
        return (image.clamp(0, 1) - mean) / std
