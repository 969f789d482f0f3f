"""The base of encoders that are a vision transformer of transformers: where its weights come from, and its patches."""

from __future__ import annotations

import math
from abc import abstractmethod
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, UInt8
from pydantic import PositiveInt
from safetensors import SafetensorError
from torch import Tensor

from persist_cli.api.encoder import Encoder
from persist_cli.errors import CheckpointError
from persist_cli.io.files import reallocate
from persist_cli.io.hub import cached_weight, hub_obstacle, in_hub_cache, without_bars

Channels = tuple[float, float, float]

_LOADING_ERRORS = (OSError, ValueError, RuntimeError, SafetensorError)


@dataclass(frozen=True, kw_only=True)
class TransformerSettings:
    """The size of the images and the block of the network that give the features.

    Args:
        size: pixels of the image's longer side when it is encoded; ``None`` keeps the size of the image. Both sides
            are then rounded to whole patches. An image of 64 pixels has 5 × 5 patches of 14 pixels, enlarged to 112
            pixels it has 8 × 8.
        layer: the block whose output is taken, counted from 1; ``None`` for the last. The final layer norm
            follows in either case.
        batch: frames encoded at once. More is faster on a GPU, but then the last bits of a feature depend on
            the frames beside it, and those of a map on how its frames were grouped.
        precision: type that the network computes in; features are float32 in either case.
    """

    size: PositiveInt | None = None
    layer: PositiveInt | None = None
    batch: PositiveInt = 1
    precision: Literal["float32", "bf16"] = "float32"


class VisionTransformer(Encoder):
    """Patch features of a frozen vision transformer; its files are opened when first needed."""

    settings: TransformerSettings
    costly = True
    mean: ClassVar[Channels]  # of the images it was trained on, in units of the full range
    deviation: ClassVar[Channels]

    def __init__(self, settings: TransformerSettings) -> None:
        super().__init__(settings)
        self._device = torch.device("cpu")

    @property
    def channels(self) -> int:
        """Width of the model.

        Raises:
            CheckpointError: when its configuration cannot be loaded.
        """
        return int(self.config.hidden_size)

    @property
    @abstractmethod
    def source(self) -> str:
        """The weights' name in error messages."""

    @abstractmethod
    def load_config(self) -> Any:
        """Return the configuration of transformers."""

    @abstractmethod
    def load_model(self) -> Any:
        """Return the network on the CPU, without the blocks after the settings' one."""

    @abstractmethod
    def patch_states(self, pixels: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame token channel"]:
        """Return the network's states of which the last are those of the patches, row by row."""

    def to(self, device: torch.device | str) -> VisionTransformer:
        """Encode on ``device`` from now on."""
        self._device = torch.device(device)
        return self

    @torch.no_grad()
    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return the normalised patch features of the chosen block, without class and register tokens."""
        self.model.to(self._device)
        rows, columns = self._rows_and_columns(rgb.shape[1], rgb.shape[2])
        parts = []
        for part in torch.split(rgb, self.settings.batch):
            pixels = self._pixels(part.to(self._device), rows, columns)
            with self._autocast():
                states = self.patch_states(pixels)
            parts.append(states[:, -rows * columns :].reshape(len(part), rows, columns, -1).float())
        return torch.cat(parts)

    @cached_property
    def config(self) -> Any:
        """The configuration of transformers; loaded on first use, and checked to have the settings' block."""
        config = self.load_config()
        if self.settings.layer is not None and self.settings.layer > config.num_hidden_layers:
            raise CheckpointError(
                f"{self.source}: it has {config.num_hidden_layers} blocks, no block {self.settings.layer}"
            )
        return config

    @cached_property
    def model(self) -> Any:
        """The network; loaded on first use."""
        model = self.load_model().eval().requires_grad_(False)
        reallocate(model)
        return model

    def _autocast(self) -> AbstractContextManager[Any]:
        if self.settings.precision == "float32":
            return nullcontext()
        return torch.autocast(self._device.type, torch.bfloat16)

    def _rows_and_columns(self, height: int, width: int) -> tuple[int, int]:
        scale = (self.settings.size or max(height, width)) / max(height, width)
        patch = self.config.patch_size
        return max(1, math.floor(height * scale / patch + 0.5)), max(1, math.floor(width * scale / patch + 0.5))

    def _pixels(self, rgb: Tensor, rows: int, columns: int) -> Float[Tensor, "frame 3 height width"]:
        patch = self.config.patch_size
        image = rgb.permute(0, 3, 1, 2).float() / 255
        size = (rows * patch, columns * patch)
        image = torch.nn.functional.interpolate(image, size=size, mode="bicubic", antialias=True, align_corners=False)
        mean, std = (image.new_tensor(values)[:, None, None] for values in (self.mean, self.deviation))
        return (image.clamp(0, 1) - mean) / std


@dataclass(frozen=True, kw_only=True)
class PublishedSettings(TransformerSettings):
    """The published weights of the network.

    Args:
        weights: a directory that transformers wrote (``config.json`` and ``model.safetensors``), the name of weights
            that ``persist weights fetch`` brought, or a hub id, which is downloaded when it is not in the hub's cache.
            Missing weights are never replaced by others.
    """

    weights: str


class PublishedTransformer(VisionTransformer):
    """A vision transformer with published weights, from fetched weights, a local directory or the hub."""

    settings: PublishedSettings
    title: ClassVar[str]  # of the network, in error messages
    widths: ClassVar[dict[str, int]]  # channels of weights known by name
    publisher: ClassVar[str]  # with which their names on the hub begin

    @property
    def source(self) -> str:
        """The setting ``weights``."""
        return self.settings.weights

    @property
    def channels_by_name(self) -> int:
        """Width of the model, also of weights known by name that are not fetched yet."""
        weights = self.settings.weights
        width = None if Path(weights).is_dir() else self.widths.get(weights.removeprefix(self.publisher))
        return self.channels if width is None else width

    def from_pretrained(self, kind: Any, **options: Any) -> Any:
        """Load a configuration or a model of transformers from the weights.

        Raises:
            CheckpointError: when they are not there or not whole.
        """
        source, local = self._source
        try:
            with without_bars():
                return kind.from_pretrained(source, local_files_only=local, **options)
        except _LOADING_ERRORS as error:
            cause = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise self._unavailable(f"{source} failed ({cause})") from error

    def load_weights(self, kind: Any) -> Any:
        """Load a model of transformers from the weights, whole.

        Raises:
            CheckpointError: when they are not there or not whole.
        """
        options = {"use_safetensors": True, "config": self.config, "dtype": torch.float32}
        model, found = self.from_pretrained(kind, output_loading_info=True, **options)
        if found["missing_keys"]:
            missing = sorted(found["missing_keys"])
            raise self._unavailable(f"they lack {len(missing)} tensors ({missing[0]})")
        return model

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
        hint = (
            "set the encoder's weights to a directory or to fetched weights (persist weights list), or take 'patches'"
        )
        return CheckpointError(f"{self.title} weights {self.settings.weights!r}: {cause}; {hint}")
