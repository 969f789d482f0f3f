"""The memory that remembers nothing: what a memory is compared with (the row "NWM" of the paper's Table 1)."""

from __future__ import annotations

from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_memory.stored_tensors import check_mergeable, check_tensors


class NoMemory(Memory):
    """Never gives a token, so that an adapter of the same size can be trained without a memory."""

    def write(self, observations: Observations) -> None:
        """Forget the frames."""

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """No token."""
        return MemoryTokens.empty(self.encoder.channels)

    def tensors(self) -> dict[str, Tensor]:
        """Nothing."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Nothing to restore.

        Raises:
            CheckpointError: when there are tensors, which are not this memory's.
        """
        check_tensors(tensors, {}, f"memory {self.name!r}")

    def merge(self, other: Memory) -> None:
        """Nothing and nothing are nothing."""
        check_mergeable(self, other)
