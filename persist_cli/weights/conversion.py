"""Conversion of a weight's original file to torch tensors under the names that the tool reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from persist_cli.errors import CheckpointError
from persist_cli.metrics import dreamsim
from persist_cli.metrics.lpips import ALEX, VGG
from persist_cli.weights.nomad import our_names, write_nomad_card
from persist_cli.weights.onnx import linear_weights, read_onnx_weights
from persist_cli.weights.unpickling import read_pickled_arrays

HEADS: Final = 5
ALEX_CHANNELS: Final = (3, *(layer.channels[1] for layer in ALEX))
VGG_CHANNELS: Final = (3, *(layer.channels[1] for layer in VGG))
DINO_BLOCKS: Final = 12
DINO_WIDTH: Final = 384
DINO_CONFIG: Final[dict[str, object]] = {
    "model_type": "dinov2",
    "architectures": ["Dinov2Model"],
    "hidden_size": DINO_WIDTH,
    "num_hidden_layers": DINO_BLOCKS,
    "num_attention_heads": 6,
    "mlp_ratio": 4,
    "patch_size": 14,
    "image_size": 518,
    "layer_norm_eps": 1e-6,
    "use_mask_token": False,  # only needed for training, and not in the file
}
I3D_UNITS: Final = 57  # convolutions with a batch norm each; one more without makes the logits

Tensors = dict[str, Tensor]


def convert_lpips(path: Path, tree: str, channels: tuple[int, ...]) -> Tensors:
    """Tensors ``conv{i}.weight``, ``conv{i}.bias`` and ``head{i}.weight`` of an LPIPS pickle, i in the network's order.

    Args:
        path: the pickle.
        tree: its branch with the convolutions; a kernel is ``[height, width, in, out]``.
        channels: number of channels of the image, then of each convolution's output.
    """
    arrays = read_pickled_arrays(path)
    convolutions = range(len(channels) - 1)
    kernels = {f"{tree}.Conv_{i}.kernel": f"conv{i}.weight" for i in convolutions}
    biases = {f"{tree}.Conv_{i}.bias": f"conv{i}.bias" for i in convolutions}
    heads = {f"NetLinLayer_{i}.Conv_0.kernel": f"head{i}.weight" for i in range(HEADS)}
    check_names(path, arrays, [*kernels, *biases, *heads])
    tensors = {new: as_tensor(arrays[old].transpose(3, 2, 0, 1)) for old, new in (kernels | heads).items()}
    for i in convolutions:
        shape = tuple(tensors[f"conv{i}.weight"].shape[:2])
        if shape != (channels[i + 1], channels[i]):
            raise CheckpointError(f"{path}: convolution {i} has (out, in) {shape}, not {channels[i + 1], channels[i]}")
    return tensors | {new: as_tensor(arrays[old]) for old, new in biases.items()}


def convert_lpips_alex(path: Path) -> Tensors:
    """Tensors of LPIPS with AlexNet, see ``convert_lpips``."""
    return convert_lpips(path, "AlexNet_0", ALEX_CHANNELS)


def convert_lpips_vgg(path: Path) -> Tensors:
    """Tensors of LPIPS with VGG16, see ``convert_lpips``."""
    return convert_lpips(path, "VGG16_0", VGG_CHANNELS)


def convert_i3d(path: Path) -> Tensors:
    """Arrays of the flax tree of I3D by their paths, a ``kernel`` as ``weight`` ``[out, in, time, height, width]``."""
    arrays = read_pickled_arrays(path)
    units = sorted(name.removesuffix(".Conv_0.kernel") for name in arrays if name.endswith(".Conv_0.kernel"))
    normed = [unit for unit in units if unit != "params.Logits/Conv3d_0c_1x1"]
    expected = [f"{unit}.Conv_0.kernel" for unit in units] + ["params.Logits/Conv3d_0c_1x1.Conv_0.bias"]
    for unit in normed:
        statistics = unit.replace("params.", "batch_stats.", 1)
        expected += [f"{unit}.BatchNorm_0.bias", f"{statistics}.BatchNorm_0.mean", f"{statistics}.BatchNorm_0.var"]
    check_names(path, arrays, expected)
    if len(normed) != I3D_UNITS:
        raise CheckpointError(f"{path}: {len(normed)} convolutions with a batch norm, I3D has {I3D_UNITS}")
    return dict(_torch_form(name, array) for name, array in arrays.items())


def convert_dinov2(path: Path) -> Tensors:
    """Tensors of the DINOv2 backbone of an ONNX file, named as the hub names those of ``DINO_CONFIG``."""
    weights = read_onnx_weights(path)
    named = {name: array for name, array in weights.arrays.items() if name.startswith("backbone.")}
    named |= {bias.removesuffix("bias") + "weight": matrix for bias, matrix in linear_weights(weights).items()}
    tensors = {name.removeprefix("backbone."): as_tensor(array) for name, array in named.items()}
    shapes = (1, 1, DINO_WIDTH), (1, (518 // 14) ** 2, DINO_WIDTH)  # of the class token's position and of the patches'
    unnamed = [array for name, array in weights.arrays.items() if name not in named]
    positions = [array for shape in shapes for array in unnamed if array.shape == shape]
    if [array.shape for array in positions] != [*shapes]:
        raise CheckpointError(f"{path}: no single position embedding of shapes {shapes[0]} and {shapes[1]}")
    tensors["embeddings.position_embeddings"] = as_tensor(np.concatenate(positions, axis=1))
    check_names(path, tensors, dinov2_names())
    return tensors


def dinov2_names() -> list[str]:
    """Names of the tensors of a DINOv2 of ``DINO_CONFIG``, as the hub has them."""
    projections = [f"attention.attention.{part}" for part in ("query", "key", "value")]
    parts = ("norm1", "norm2", "mlp.fc1", "mlp.fc2", "attention.output.dense", *projections)
    names = ["embeddings.cls_token", "embeddings.position_embeddings"]
    for layer in ("layernorm", "embeddings.patch_embeddings.projection"):
        names += [f"{layer}.weight", f"{layer}.bias"]
    for block in range(DINO_BLOCKS):
        names += [f"encoder.layer.{block}.{part}.{kind}" for part in parts for kind in ("weight", "bias")]
        names += [f"encoder.layer.{block}.layer_scale{number}.lambda1" for number in (1, 2)]
    return names


def convert_state_dict(path: Path) -> Tensors:
    """The tensors of a torch file, opened by torch's loader that admits nothing but weights."""
    import pickle

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, EOFError, RuntimeError, ValueError, OSError, LookupError, TypeError) as error:
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{path}: refused, not a torch file of weights only ({cause})") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(f"{path}: not a dictionary of tensors")
    return {str(name): value.contiguous() for name, value in state.items()}


def convert_nomad(path: Path) -> Tensors:
    """The tensors of NoMaD's published file under the names of our network."""
    return our_names(convert_state_dict(path), path)


def check_names(path: Path, names: Iterable[str], expected: Iterable[str]) -> None:
    """Raise ``CheckpointError`` with the number of names that are missing or unknown, and one of each."""
    missing, unknown = sorted(set(expected) - set(names)), sorted(set(names) - set(expected))
    if missing or unknown:
        parts = [
            f"{len(part)} {what} ({part[0]})" for part, what in ((missing, "missing"), (unknown, "unknown")) if part
        ]
        raise CheckpointError(f"{path}: not the expected weights: {', '.join(parts)}")


def as_tensor(array: np.ndarray) -> Tensor:
    """The array as a float32 tensor with memory of its own."""
    return torch.from_numpy(np.array(array, dtype=np.float32, order="C"))


def _torch_form(name: str, array: np.ndarray) -> tuple[str, Tensor]:
    if name.endswith(".kernel"):
        return name.removesuffix("kernel") + "weight", as_tensor(array.transpose(4, 3, 0, 1, 2))
    return name, as_tensor(array)


CONVERSIONS: Final[dict[str, Callable[[Path], Tensors]]] = {
    "dinov2-s-derived": convert_dinov2,
    "lpips-alex": convert_lpips_alex,
    "lpips-vgg": convert_lpips_vgg,
    "i3d-kinetics-400": convert_i3d,
    "efficientnet-lite0": convert_state_dict,
    "nomad": convert_nomad,
}

CONFIGS: Final[dict[str, dict[str, object]]] = {"dinov2-s-derived": DINO_CONFIG}

# of what is taken as it is, and no hash is known of
SHAPES: Final[dict[str, Callable[[], dict[str, tuple[int, ...]]]]] = {"dreamsim": dreamsim.tensor_shapes}

CARDS: Final[dict[str, Callable[[Path], None]]] = {"nomad": write_nomad_card}  # of policies, beside their weights
