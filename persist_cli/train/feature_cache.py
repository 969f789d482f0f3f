"""A cache of an encoder's features: each trajectory is encoded once, whatever clips and contexts are drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch

from persist_cli.data.store import TrajectoryFile
from persist_cli.memorize.kept_features import KeptFeatures, frame_digests
from persist_cli.memorize.sources import Source
from persist_cli.train.tensor_cache import ROWS, TensorCache, cache_key

FRAMES: Final = "frames"  # the tensor of the frames' digests in an entry; another one has their features


class FeatureCache:
    """Brings the features of a trajectory's frames to an encoder that keeps them, from a folder where they are there.

    Args:
        cache: the tensors by key; an entry has the features of a whole trajectory.
        depends: the JSON values that features depend on besides the frames.
        encoder: the encoder that keeps them.
    """

    def __init__(self, cache: TensorCache, depends: dict[str, Any], encoder: KeptFeatures) -> None:
        self.cache, self.depends, self.encoder = cache, depends, encoder
        self._digests: dict[tuple[str, int], bytes] = {}  # of each frame that was brought, by entry and number

    def bring(self, file: TrajectoryFile, frames: Sequence[int]) -> None:
        """Let the encoder have the features of some frames, as far as it has room and the folder too.

        Args:
            file: the trajectory.
            frames: numbers of the frames; the first of a trajectory that are brought have all its frames encoded.
        """
        key = cache_key({"trajectory": self.cache.hashes.of(file)} | ROWS | self.depends)
        digests = {frame: self._digests.get((key, frame), b"") for frame in frames}
        missing = [frame for frame, digest in digests.items() if digest not in self.encoder]
        self.encoder.renew(digests.values())  # the missing ones shall not take their place
        if not missing:
            return
        tensors = self.cache.get(key, missing)
        if tensors is None:
            if self.cache.full:  # a whole trajectory would be encoded again for each clip
                return
            tensors = self._encode(file)
            self.cache.put_rows(key, tensors)
            tensors = {name: tensor[missing] for name, tensor in tensors.items()}
        brought = [bytes(row.tolist()) for row in tensors[FRAMES]]
        self._digests |= {(key, frame): digest for frame, digest in zip(missing, brought, strict=True)}
        self.encoder.keep(brought, tensors["features"])

    def _encode(self, file: TrajectoryFile) -> dict[str, torch.Tensor]:
        digests: list[bytes] = []
        features = []
        for piece in Source(file, range(len(file)), str(file.path)).pieces():
            digests += frame_digests(piece.rgb)
            features.append(self.encoder.encoded(piece.rgb.to(self.encoder.device)).cpu())
        rows = torch.tensor([list(digest) for digest in digests], dtype=torch.uint8)
        return {FRAMES: rows, "features": torch.cat(features)}
