"""Kernel distance of single frames in DINOv2 features: are frames of places that were never seen like real ones?

KID (Bińkowski et al. 2018) with another network: the squared maximum mean discrepancy of two sets of features under the
kernel (x·y / channels + 1)³, without bias. DINOv2 in place of Inception follows Stein et al. 2023, whose distance is
Fréchet's (FD-DINOv2); a kernel distance needs far fewer frames. Frames of one house are no independent draws, nor are a
generated frame and the true one of its camera; so pairs within a house are left out of all means.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from persist_cli.metrics.metric import FrameSetMetric, Setup
from persist_cli.metrics.networks import missing_weights
from persist_cli.metrics.src import ENCODERS, chosen_encoder, encode_frames

SIZE = 112  # pixels of the longer side

UNSEEN = 0.5  # frames count of whose view less than this share was seen before

CHUNK = 16  # frames that are encoded at once


class KernelDistance(FrameSetMetric):
    """KD-DINOv2 of the frames of which most was never seen before."""

    name = "kd-dinov2"
    title = "KD-DINOv2 unseen"
    better = "lower"

    @property
    def definition(self) -> str:
        """A sentence with frames, encoder and kernel."""
        return (
            "1000 × squared kernel distance (MMD, (x·y / channels + 1)³, unbiased as KID, without pairs of one scene) "
            f"of generated from true frames of whose view less than {UNSEEN:.0%} was seen before; "
            f"{chosen_encoder().title} with the final layer norm, mean of patch tokens, longer side resized to {SIZE} "
            "px (bicubic, antialiased); no FID, which needs Inception; may be slightly below 0"
        )

    @property
    def weights(self) -> tuple[str, ...]:
        """The weights of the encoder that is used, the first that is cached."""
        return (chosen_encoder().name,)

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when fewer than two scenes have such frames, or no encoder is cached."""
        if setup.unseen_scenes < 2:
            return (
                f"{setup.unseen_scenes} scenes have frames of whose view less than {UNSEEN:.0%} was seen before, "
                "it needs two"
            )
        return missing_weights(*(encoder.name for encoder in ENCODERS))

    def features(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame channel"]:
        """The mean patch features of each frame, float32 on the CPU."""
        return torch.cat([encode_frames(part, SIZE).flatten(1, 2).mean(1) for part in rgb.split(CHUNK)])

    def scene_sums(
        self,
        features: Float[Tensor, "frame channel"],
        true_features: Float[Tensor, "frame channel"],
        scenes: Int64[Tensor, " frame"],
    ) -> tuple[Float[Tensor, "scene scene"], Float[Tensor, "scene scene"]]:
        """Sums of k(x, x') + k(y, y') − k(x, y') − k(y, x') over pairs of frames of two scenes, 1000 times.

        Both results are zero on the diagonal, where pairs of one scene would stand.
        """
        generated, true = features.double(), true_features.double()
        mixed = kernel(generated, true)
        values = 1000 * (kernel(generated, generated) + kernel(true, true) - mixed - mixed.T)
        members = torch.nn.functional.one_hot(scenes).double()
        counts = members.sum(0)
        apart = 1 - torch.eye(len(counts), dtype=torch.float64)
        return (members.T @ values @ members) * apart, torch.outer(counts, counts) * apart


def kernel(first: Float[Tensor, "one channel"], second: Float[Tensor, "two channel"]) -> Float[Tensor, "one two"]:
    """The cubic polynomial kernel of KID."""
    return (first @ second.T / first.shape[1] + 1) ** 3
