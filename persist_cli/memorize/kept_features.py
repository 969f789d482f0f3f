"""Features of frames that were encoded before: a network of the size of DINOv2 sees no frame twice."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterable
from typing import Final

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.encoder import Encoder

ROOM: Final = 1 << 30  # bytes of features that are kept
DIGEST: Final = 16  # bytes that stand for a frame; that two of 10¹² frames have the same has odds of 1 to 10¹⁴


class KeptFeatures(Encoder):
    """An encoder that keeps the features of the frames it encoded last, found again by the frames' own pixels.

    Frames that are not kept are encoded by the other encoder, in one call. Where that gives a frame the same features
    whatever frames are beside it, so does this one.

    Args:
        encoder: the encoder.
        room: bytes of features that are kept, in the memory of the CPU; those not used for longest leave first.
    """

    costly = True

    def __init__(self, encoder: Encoder, room: int = ROOM) -> None:
        super().__init__(encoder.settings)
        self.encoder, self.name, self.room, self.used = encoder, encoder.name, room, 0
        self.device = torch.device("cpu")
        self._kept: OrderedDict[bytes, Tensor] = OrderedDict()

    def __contains__(self, digest: bytes) -> bool:
        return digest in self._kept

    @property
    def channels(self) -> int:
        """The number of feature channels."""
        return self.encoder.channels

    @property
    def channels_by_name(self) -> int:
        """The number of feature channels, without loading weights where their name tells it."""
        return self.encoder.channels_by_name

    def to(self, device: torch.device | str) -> KeptFeatures:
        """Encode on ``device`` from now on; what is kept stays in the memory of the CPU."""
        self.encoder, self.device = self.encoder.placed(device), torch.device(device)
        return self

    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return the features of the frames, of which only those that are not kept are encoded."""
        digests = frame_digests(rgb)
        features = {digest: self._kept[digest].to(self.device) for digest in digests if digest in self._kept}
        missing = {digest: number for number, digest in enumerate(digests) if digest not in features}
        if missing:
            encoded = self.encoder.encoded(rgb[list(missing.values())])
            features |= dict(zip(missing, encoded, strict=True))
            if not encoded.is_meta:  # there is nothing to keep
                self.keep(missing, encoded)
        self.renew(digests)
        return torch.stack([features[digest] for digest in digests])

    def renew(self, digests: Iterable[bytes]) -> None:
        """Let the features of frames with these digests, as far as they are kept, leave after all others."""
        for digest in digests:
            if digest in self._kept:
                self._kept.move_to_end(digest)

    def keep(self, digests: Iterable[bytes], features: Float[Tensor, "frame rows columns channel"]) -> None:
        """Keep the features of frames with these digests."""
        for digest, frame in zip(digests, features, strict=True):
            if digest not in self._kept:
                self._kept[digest] = frame.detach().cpu().clone()
                self.used += frame.nbytes
            self._kept.move_to_end(digest)
        while self.used > self.room:
            _, oldest = self._kept.popitem(last=False)
            self.used -= oldest.nbytes


def frame_digests(rgb: UInt8[Tensor, "frame height width 3"]) -> list[bytes]:
    """A digest of the pixels and the size of each frame."""
    size = str(tuple(rgb.shape[1:])).encode()
    return [hashlib.blake2b(frame.numpy().tobytes(), digest_size=DIGEST, key=size).digest() for frame in rgb.cpu()]
