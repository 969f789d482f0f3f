"""DreamSim, single branch: distance of a DINO ViT-B/16 tuned on human judgements (Fu et al. 2023).

``persist weights fetch`` cannot convert its weights from any source: they are released as a checkpoint of DINO with a
LoRA adapter beside it, both pickled. To prepare them from the release (``dino_vitb16``), add the adapter's product,
scaled by alpha / rank, to ``qkv`` of every block, and write ``model.safetensors`` into a folder for ``--from``: DINO's
own tensor names without head, float32, as ``tensor_shapes`` lists them. The ensemble of three branches is another
metric and is not measured here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.metrics.networks import missing_weights, network_weights, run_network

WEIGHTS = "dreamsim"
SIZE = 224
PATCH = 16
WIDTH = 768
BLOCKS = 12
HEADS = 12
EPSILON = 1e-6  # of layer norms
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


class DreamSim(FrameMetric):
    """DreamSim of RGB frames by its single DINO branch."""

    name = "dreamsim"
    title = "DreamSim"
    better = "lower"
    weights = (WEIGHTS,)
    definition = (
        "DreamSim, single branch dino_vitb16: 1 - cosine similarity of the class token after block 12 (no final norm) "
        f"less its mean, frames resized to {SIZE}×{SIZE} (Pillow bicubic, 8 bit), float32"
    )

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when the weights are not cached; only a folder can bring them."""
        missing = missing_weights(WEIGHTS)
        return missing and f"{missing} --from DIR"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The distance of each frame, 0 for an exact copy."""
        weights = network_weights(WEIGHTS, tensor_shapes())
        pair = (resize(rgb.cpu()) for rgb in (prediction.rgb, prediction.truth.rgb))
        return run_network(lambda rgb, truth: distance(weights, rgb, truth), *pair)


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tensors of ``model.safetensors`` by name."""
    shapes: dict[str, tuple[int, ...]] = {
        "cls_token": (1, 1, WIDTH),
        "pos_embed": (1, (SIZE // PATCH) ** 2 + 1, WIDTH),
        "patch_embed.proj.weight": (WIDTH, 3, PATCH, PATCH),
        "patch_embed.proj.bias": (WIDTH,),
        "norm.weight": (WIDTH,),
        "norm.bias": (WIDTH,),
    }
    linear = {"attn.qkv": (3, 1), "attn.proj": (1, 1), "mlp.fc1": (4, 1), "mlp.fc2": (1, 4)}
    for block in range(BLOCKS):
        for norm in ("norm1", "norm2"):
            shapes[f"blocks.{block}.{norm}.weight"] = shapes[f"blocks.{block}.{norm}.bias"] = (WIDTH,)
        for name, (outputs, inputs) in linear.items():
            shapes[f"blocks.{block}.{name}.weight"] = (outputs * WIDTH, inputs * WIDTH)
            shapes[f"blocks.{block}.{name}.bias"] = (outputs * WIDTH,)
    return shapes


def resize(rgb: UInt8[Tensor, "frame height width 3"]) -> UInt8[Tensor, "frame 224 224 3"]:
    """Resize frames as the released preprocessing does, by Pillow's bicubic filter on 8-bit pixels."""
    from PIL import Image

    images = [Image.fromarray(frame.numpy()).resize((SIZE, SIZE), Image.Resampling.BICUBIC) for frame in rgb]
    return torch.from_numpy(np.stack([np.asarray(image) for image in images]))


def distance(
    weights: Mapping[str, Tensor], rgb: UInt8[Tensor, "frame 224 224 3"], truth: UInt8[Tensor, "frame 224 224 3"]
) -> Float[Tensor, " frame"]:
    """Return for each frame one minus the cosine similarity of the class tokens less their means."""
    return token_distance(class_token(weights, rgb), class_token(weights, truth))


def token_distance(
    tokens: Float[Tensor, "frame channel"], true_tokens: Float[Tensor, "#frame channel"]
) -> Float[Tensor, " frame"]:
    """Return the same distance of class tokens; the truth may be a single frame, with which all compare."""
    centred, true_centred = (token.double() - token.double().mean(-1, keepdim=True) for token in (tokens, true_tokens))
    return 1 - torch.cosine_similarity(centred, true_centred, dim=-1)


def class_token(weights: Mapping[str, Tensor], rgb: UInt8[Tensor, "frame 224 224 3"]) -> Float[Tensor, "frame channel"]:
    """Return the class token of each frame after the last block, without the final norm."""
    image = rgb.permute(0, 3, 1, 2).float() / 255
    mean, std = (image.new_tensor(values)[:, None, None] for values in (MEAN, STD))
    kernel, bias = weights["patch_embed.proj.weight"], weights["patch_embed.proj.bias"]
    patches = functional.conv2d((image - mean) / std, kernel, bias, stride=PATCH).flatten(2).transpose(1, 2)
    tokens = torch.cat([weights["cls_token"].expand(len(rgb), -1, -1), patches], dim=1) + weights["pos_embed"]
    for block in range(BLOCKS):
        tokens = _block(weights, f"blocks.{block}", tokens)
    return tokens[:, 0]


def _block(weights: Mapping[str, Tensor], name: str, tokens: Tensor) -> Tensor:
    """Apply attention and a two-layer network, each after a layer norm and added to its input."""

    def linear(part: str, inputs: Tensor) -> Tensor:
        return functional.linear(inputs, weights[f"{name}.{part}.weight"], weights[f"{name}.{part}.bias"])

    def norm(part: str) -> Tensor:
        weight, bias = weights[f"{name}.{part}.weight"], weights[f"{name}.{part}.bias"]
        return functional.layer_norm(tokens, (WIDTH,), weight, bias, EPSILON)

    frames, count, _ = tokens.shape
    parts = linear("attn.qkv", norm("norm1")).reshape(frames, count, 3, HEADS, WIDTH // HEADS)
    query, key, value = parts.permute(2, 0, 3, 1, 4)
    mixed = functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(tokens.shape)
    tokens = tokens + linear("attn.proj", mixed)
    return tokens + linear("mlp.fc2", functional.gelu(linear("mlp.fc1", norm("norm2"))))
