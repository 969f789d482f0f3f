"""A cache of an encoder's features: each trajectory is encoded once, whatever clips and contexts are drawn from it."""

from __future__ import annotations

from typing import Any, Final

import torch

from persist_cli.data.store import TrajectoryFile
from persist_cli.memorize.kept_features import KeptFeatures, frame_digests
from persist_cli.memorize.sources import Source
from persist_cli.train.tensor_cache import TensorCache, cache_key

FRAMES: Final = "frames"  # the tensor of the frames' digests in an entry; the other one has their features


class FeatureCache:
    """Brings the features of a trajectory's frames to an encoder that keeps them, from a folder where they are there.

    Args:
        cache: the tensors by key; an entry has the features of a whole trajectory.
        depends: the JSON values that features depend on besides the frames.
        encoder: the encoder that keeps them.
    """

    def __init__(self, cache: TensorCache, depends: dict[str, Any], encoder: KeptFeatures) -> None:
        self.cache, self.depends, self.encoder = cache, depends, encoder
        self._digests: dict[str, list[bytes]] = {}  # of the frames of each trajectory that was brought

    def bring(self, file: TrajectoryFile, file_hash: str) -> None:
        """Let the encoder have the features of all frames of a trajectory, as far as it has room and the folder too.

        Args:
            file: the trajectory.
            file_hash: SHA-256 of its file.
        """
        key = cache_key({"trajectory": file_hash} | self.depends)
        if key in self._digests and all(digest in self.encoder for digest in self._digests[key]):
            return
        tensors = self.cache.get(key)
        if tensors is None:
            if self.cache.full:  # a whole trajectory would be encoded again for each clip
                return
            tensors = self._encode(file)
            self.cache.put(key, tensors)
        self._digests[key] = [bytes(row.tolist()) for row in tensors[FRAMES]]
        self.encoder.keep(self._digests[key], tensors["features"])

    def _encode(self, file: TrajectoryFile) -> dict[str, torch.Tensor]:
        digests: list[bytes] = []
        features = []
        for piece in Source(file, range(len(file)), str(file.path)).pieces():
            digests += frame_digests(piece.rgb)
            features.append(self.encoder.encoded(piece.rgb.to(self.encoder.device)).cpu())
        rows = torch.tensor([list(digest) for digest in digests], dtype=torch.uint8)
        return {FRAMES: rows, "features": torch.cat(features)}
