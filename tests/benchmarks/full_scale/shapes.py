"""The measured models with random weights on the device: the published sizes and small twins of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from diffusers import CogVideoXDDIMScheduler

from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.plugins import make_backbone
from tests.support.room_views import observe
from tests.support.rooms import UP, Room, look

ADAPTER = "voxel"


@dataclass(frozen=True)
class Model:
    """A model to measure.

    Args:
        name: its name in the table.
        settings: settings of the backbone.
        adapter: settings of its memory adapter.
        batch: clips in a training step.
        channels: channels of the map's features.
        published: whether it is one of the published sizes, for which there are targets.
    """

    name: str
    settings: dict[str, Any]
    adapter: dict[str, Any]
    batch: int
    channels: int
    published: bool = False


SMALL = {
    "num_attention_heads": 6, "num_layers": 8, "time_embed_dim": 256, "text_embed_dim": 64, "max_text_seq_length": 16,
    "use_rotary_positional_embeddings": True,
}  # fmt: skip

FULL_SCALE = {"height": 512, "width": 512}

BLOCKS = {"form": "cross", "every": 2, "ff_factor": 0.5, "token_budget": 1024}

MODELS = {
    model.name: model
    for model in (
        Model("tiny", {"preset": "tiny"}, {"form": "cross", "every": 2}, 4, 32),
        Model("small", {"preset": "tiny", "height": 96, "width": 96, "transformer": SMALL,
                        "vae": {"block_out_channels": [16, 32, 64]}},
              BLOCKS | {"width": 128, "token_budget": 256}, 1, 96),
        Model("2b", {"preset": "2b"} | FULL_SCALE, BLOCKS | {"width": 640, "heads": 10}, 8, 384, True),
        Model("5b", {"preset": "5b-i2v"} | FULL_SCALE, BLOCKS | {"width": 1024, "heads": 16}, 4, 384, True),
    )
}  # fmt: skip


@dataclass
class Bench:
    """One model on one device.

    Args:
        model: the model to build.
        device: device of its weights.
        precision: precision of weights and arithmetic.
        rounds: measured runs of each function, after a warm-up that does not count.
        peak: FLOP/s that the device can do in this precision.
        changes: changes of the training recipes, as ``training.compile=true``.
        mixed: whether steps hold float32 weights and compute in bf16, as the recipes of the published models do.
    """

    model: Model
    device: torch.device
    precision: torch.dtype
    rounds: int
    peak: float
    changes: tuple[str, ...] = ()
    mixed: bool = False
    backbone: Any = field(init=False)

    def __post_init__(self) -> None:
        with self.built_on_device():
            self.backbone = make_backbone("cogvideox", self.model.settings)
            self.backbone.add_adapter(ADAPTER, self.model.channels, self.model.adapter)
        scheduler = CogVideoXDDIMScheduler.from_config(self.backbone.scheduler.config)  # one whose tables are float32
        self.backbone.scheduler = scheduler
        self.backbone.to(self.device, self.precision).eval()

    @contextmanager
    def training(self) -> Iterator[None]:
        """Within the block weights have the precision of training steps."""
        usual, self.precision = self.precision, torch.float32 if self.mixed else self.precision
        self.backbone.to(self.precision)
        try:
            yield
        finally:
            self.precision = usual
            self.backbone.to(usual)

    @contextmanager
    def built_on_device(self) -> Iterator[None]:
        """Within the block modules are built on the device, in its precision, rather than moved there."""
        before = torch.get_default_dtype()
        torch.set_default_dtype(self.precision)
        try:
            with torch.device(self.device):
                yield
        finally:
            torch.set_default_dtype(before)

    @property
    def size(self) -> tuple[int, int, int]:
        """Frames, height and width of a clip."""
        settings = self.backbone.settings
        return settings.frames, settings.height, settings.width

    def walk(self) -> Observations:
        """A clip of the furnished room: ahead, turning to the left."""
        frames, height, width = self.size
        return observe([look((0.0, 1.4, 1.2 - 0.1 * step), 5.0 * step) for step in range(frames)], height, width)

    def info(self) -> TrajectoryInfo:
        """The info of the room, whose agent walks by quarters of a metre and turns by 15°."""
        _, height, width = self.size
        return TrajectoryInfo("room", Room(height, width).intrinsics, height, width, UP, walking_actions(0.25, 15.0))

    def clips(self, batch: int, frames: int, observations: Observations | None = None) -> Clips:
        """A batch of the same clip, whose first ``frames`` frames have images."""
        seen = observations or self.walk()
        spread, cameras = [batch, -1, -1, -1], seen.cameras
        poses, intrinsics = cameras.world_from_camera.expand(spread), cameras.intrinsics.expand(spread)
        return Clips(
            rgb=seen.rgb[:frames].expand(batch, -1, -1, -1, -1).to(self.device),
            depth=seen.depth[:frames].expand(spread).to(self.device),
            cameras=Cameras(poses, intrinsics, cameras.height, cameras.width),
            interactions=[(None,) * (len(cameras) - 1)] * batch,
            tokens=None,
            seeds=list(range(batch)),
        )
