"""Raw context: the last frames, as they were seen (the row "NWM" of the paper's Table 1; Echo-Memory's baseline)."""

from __future__ import annotations

import torch
from jaxtyping import Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_memory.frames.frame_memory import FrameMemory, FrameStore


class ContextMemory(FrameMemory):
    """A window over the last ``count`` frames, observed or imagined, read with the newest first.

    It is no map: what leaves the window is forgotten, wherever the cameras look. NWM, and so the paper's row of that
    name, has a window of four frames.
    """

    def kept(self, store: FrameStore) -> FrameStore:
        """Return the last ``count`` frames."""
        return store[-self.settings.count :]

    def choose(self, store: FrameStore, cameras: Cameras, count: int) -> Int64[Tensor, " chosen"]:
        """Return the numbers of the last frames."""
        return torch.arange(len(store), device=store.images.device).flip(0)[:count]
