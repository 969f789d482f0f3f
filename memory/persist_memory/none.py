"""The memory that remembers nothing: the baseline of every other memory."""

from __future__ import annotations

from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_memory.validation import check_mergeable, check_tensors


class NoMemory(Memory):
    """A memory that never gives a token, so that an adapter of the same size can be trained without one."""

    reads_depth = False

    def write(self, observations: Observations) -> None:
        """Ignore the frames."""

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return no token."""
        return MemoryTokens.empty(self.encoder.channels)

    def tensors(self) -> dict[str, Tensor]:
        """Return no tensor."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore nothing.

        Raises:
            CheckpointError: when there is a tensor, since it belongs to another memory.
        """
        check_tensors(tensors, {}, f"memory {self.name!r}")

    def merge(self, other: Memory) -> None:
        """Check that the other memory is of this kind; there is nothing to merge."""
        check_mergeable(self, other)
