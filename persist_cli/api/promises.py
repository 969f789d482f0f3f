"""What a plugin promises to return, checked where it is taken.

What a plugin raises becomes one line that names it. These checks make one line of what it returns wrongly, which would
go on as a black frame, a map that cannot be read again, or an error far from its cause.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn

from persist_cli.api.cells import CellOrigin
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import PluginError
from persist_cli.io.files import SAFETENSORS_TYPES

LOGGED: Final = ("step", "seconds", "learning_rate")  # of each step of a training, in its log

TOKEN_PARTS: Final[dict[str, tuple[torch.dtype, tuple[int | None, ...]]]] = {  # type, and shape of a token
    "features": (torch.float32, (None,)),
    "positions": (torch.float64, (3,)),
    "mask": (torch.bool, ()),
    "colors": (torch.uint8, (3,)),
    "origins": (torch.uint8, ()),
    "distances": (torch.float32, ()),
    "images": (torch.uint8, (None, None, 3)),
    "world_from_camera": (torch.float64, (4, 4)),
    "intrinsics": (torch.float64, (3, 3)),
}


@contextlib.contextmanager
def kept(kind: str, name: str, method: str, **given: Any) -> Iterator[None]:
    """Within the block runs a method of a plugin, which must leave the tensors that it is given as they are.

    Others read them after it: they are the truth of a prediction, or the goal of every round of a plan. A change by
    NumPy is not noticed.

    Args:
        kind: kind of the plugin.
        name: its name.
        method: the method's name.
        given: the method's arguments.

    Raises:
        PluginError: when one has changed.
    """
    versions = [
        (place, tensor, tensor._version) for place, tensor in _tensors_in(given, "") if not tensor.is_inference()
    ]
    yield
    for place, tensor, version in versions:
        if tensor._version != version:
            raise _broken(kind, name, f"{method} changed {place}, which it was given; it may change a clone of it")


def _tensors_in(values: Any, place: str) -> Iterator[tuple[str, Tensor]]:
    """All tensors in arguments, with their names as Python has them."""
    if isinstance(values, Tensor):
        yield place, values
    elif isinstance(values, Mapping):
        for name, value in values.items():
            yield from _tensors_in(value, str(name))
    elif isinstance(values, list | tuple):
        for number, value in enumerate(values):
            yield from _tensors_in(value, f"{place}[{number}]")
    elif dataclasses.is_dataclass(values):
        for field in dataclasses.fields(values):
            yield from _tensors_in(getattr(values, field.name), f"{place}.{field.name}")


def check_tokens(tokens: Any, memory: str, channels: int, budget: int) -> None:
    """Raise ``PluginError`` when a memory's tokens of a path are not what ``Memory.read`` promises.

    Args:
        tokens: what the memory returned.
        memory: its name.
        channels: features of its encoder.
        budget: the largest number of tokens that was asked for.
    """
    if not isinstance(tokens, MemoryTokens):
        raise _broken("memory", memory, f"read gave {_kind(tokens)}, not MemoryTokens")
    flaw = _wrong_part(tokens)
    if not flaw and len(tokens) > budget:
        flaw = f"{len(tokens)} tokens of at most {budget}"
    if not flaw and tokens.features.shape[1] != channels:
        flaw = f"{tokens.features.shape[1]} features, where its encoder has {channels}"
    if flaw:
        raise _broken("memory", memory, f"read gave {flaw}")


def _wrong_part(tokens: MemoryTokens) -> str:
    """What is wrong with a tensor of a sample of tokens, empty when nothing is."""
    parts = tokens.tensors()
    for name, (dtype, shape) in TOKEN_PARTS.items():
        if name not in parts and name in ("features", "positions", "mask"):
            return f"tokens without {name}"
        if name in parts and not _is_of(parts[name], dtype, (None, *shape)):
            wanted = f"{str(dtype).removeprefix('torch.')} {_shape(('token', *shape))}"
            return f"{name} as {_kind(parts[name])}, not {wanted}"
        if name in parts and parts[name].requires_grad:
            return f"{name} with a gradient; compute them under torch.no_grad()"
    lengths = {name: len(parts[name]) for name in TOKEN_PARTS if name in parts}
    if len(set(lengths.values())) > 1:
        return f"tokens of several lengths: {', '.join(f'{length} {name}' for name, length in lengths.items())}"
    if not is_finite(tokens.features) or not is_finite(tokens.positions):
        return "features or positions that are not finite"
    if len(tokens) and not tokens.origins.is_meta and int(tokens.origins.amax()) > max(Origin):
        return f"origins beyond {int(max(Origin))}"
    return ""


def check_stored(tensors: Any, memory: str, reserved: str) -> None:
    """Raise ``PluginError`` when what a memory stores cannot be a memory file.

    Args:
        tensors: what ``Memory.tensors`` returned.
        memory: its name.
        reserved: no tensor's name may begin with this.
    """
    if not isinstance(tensors, Mapping):
        raise _broken("memory", memory, f"tensors gave {_kind(tensors)}, not tensors by name")
    for name, tensor in tensors.items():
        if not isinstance(name, str) or name.startswith((reserved, "__")):
            raise _broken("memory", memory, f"tensors gave a name {name!r}; no name begins with {reserved!r} or '__'")
        if not isinstance(tensor, Tensor) or not tensor.ndim or tensor.is_complex():
            raise _broken("memory", memory, f"tensors gave {name} as {_kind(tensor)}, not a tensor of items")
        kind = str(tensor.dtype).removeprefix("torch.")
        if tensor.is_meta or tensor.layout != torch.strided or kind not in SAFETENSORS_TYPES:
            raise _broken("memory", memory, f"tensors gave {name}, whose values a safetensors file cannot hold")


def check_points(points: Any, memory: str) -> None:
    """Raise ``PluginError`` when the points of a memory cannot be drawn.

    Args:
        points: what ``Memory.points`` returned.
        memory: the memory's name.
    """
    parts: list[Any] = [getattr(points, part, None) for part in ("positions", "colors", "origins", "spread", "rise")]
    if any(part is None for part in parts):
        raise _broken("memory", memory, f"points gave {_kind(points)}, not MapPoints")
    positions, colors, origins, spread, rise = parts
    if not (isinstance(positions, Tensor) and positions.is_floating_point() and positions.shape[1:] == (3,)):
        raise _broken("memory", memory, f"points gave positions as {_kind(positions)}, not float [point, 3]")
    if not _is_of(colors, torch.uint8, (len(positions), 3)):
        raise _broken("memory", memory, f"points gave colours as {_kind(colors)}, not uint8 [{len(positions)}, 3]")
    if not _is_of(origins, torch.uint8, (len(positions),)):
        raise _broken("memory", memory, f"points gave origins as {_kind(origins)}, not uint8 [{len(positions)}]")
    if not is_finite(positions):
        raise _broken("memory", memory, "points gave positions that are not finite")
    if len(origins) and int(origins.amax()) > max(CellOrigin):
        raise _broken("memory", memory, f"points gave origins beyond {int(max(CellOrigin))}")
    if not (_is_length(spread) and math.isfinite(spread) and _is_length(rise)):
        raise _broken("memory", memory, f"points gave the spread {spread!r} and the rise {rise!r}, not metres")


def check_figures(figures: Any, memory: str) -> None:
    """Raise ``PluginError`` when the figures of a memory are no numbers of items, some of them imagined.

    Args:
        figures: what ``Memory.figures`` returned.
        memory: the memory's name.
    """
    if not all(hasattr(figures, part) for part in ("cells", "imagined", "bytes", "bounds")):
        raise _broken("memory", memory, f"figures gave {_kind(figures)}, not MemoryFigures")
    cells, imagined = figures.cells, figures.imagined
    if not all(isinstance(count, int) for count in (cells, imagined)) or not 0 <= imagined <= cells:
        raise _broken("memory", memory, f"figures gave {imagined!r} imagined of {cells!r} items")
    size, bounds = figures.bytes, figures.bounds
    if not isinstance(size, int) or size < 0:
        raise _broken("memory", memory, f"figures gave {size!r} bytes")
    if bounds is not None and not (
        isinstance(bounds, tuple | list) and len(bounds) == 2 and all(map(_is_place, bounds))
    ):
        raise _broken("memory", memory, f"figures gave the bounds {bounds!r}, not two corners in metres")


def check_features(features: Any, encoder: str, channels: Any, frames: int) -> None:
    """Raise ``PluginError`` when an encoder's features are not what ``Encoder.encode`` promises.

    Args:
        features: what the encoder returned.
        encoder: its name.
        channels: the number of features that it says to have.
        frames: number of images that it was given.
    """
    if isinstance(channels, bool) or not isinstance(channels, int) or channels < 1:
        raise _broken("encoder", encoder, f"its channels are {channels!r}, not a number from 1 on")
    if not (isinstance(features, Tensor) and features.is_floating_point() and features.ndim == 4):
        raise _broken("encoder", encoder, f"encode gave {_kind(features)}, not float [frame, rows, columns, channel]")
    if len(features) != frames or features.shape[3] != channels or not features[0].numel():
        wanted = f"{frames} frames of [rows, columns, {channels}]"
        raise _broken("encoder", encoder, f"encode gave {_kind(features)}, not {wanted}")
    if not is_finite(features):
        raise _broken("encoder", encoder, "encode gave features that are not finite")


def check_generated(images: Any, backbone: str, shape: tuple[int, ...]) -> None:
    """Raise ``PluginError`` when generated images are not what ``Backbone.generate`` promises.

    Args:
        images: what the backbone returned: colours, and depth in metres.
        backbone: its name.
        shape: that of the depth: clips, frames with the first one, where there are several, height and width.
    """
    if not isinstance(images, tuple | list) or len(images) != 2:
        raise _broken("backbone", backbone, f"gave {_kind(images)}, not colours and depth")
    rgb, depth = images
    if not _is_of(rgb, torch.uint8, (*shape, 3)):
        raise _broken("backbone", backbone, f"gave colours as {_kind(rgb)}, not uint8 {_shape((*shape, 3))}")
    if not (isinstance(depth, Tensor) and depth.is_floating_point() and tuple(depth.shape) == shape):
        raise _broken("backbone", backbone, f"gave depth as {_kind(depth)}, not float {_shape(shape)}")
    if not is_finite(depth) or bool((depth < 0).any()):
        raise _broken("backbone", backbone, "gave depth that is negative or not finite")


def check_cells(cells: Any, model: str, method: str, shape: tuple[int, ...], classes: int) -> None:
    """Raise ``PluginError`` when the cells of a scene model are not what its methods promise.

    Args:
        cells: what the model returned: classes, and colours.
        model: its name.
        method: that returned them.
        shape: windows, and cells of each along the two ground axes and up.
        classes: number of classes of the model's palette.
    """
    if not isinstance(cells, tuple | list) or len(cells) != 2:
        raise _broken("scene model", model, f"{method} gave {_kind(cells)}, not classes and colours")
    for part, values, wanted in zip(("classes", "colours"), cells, (shape, (*shape, 3)), strict=True):
        if not _is_of(values, torch.uint8, wanted):
            raise _broken("scene model", model, f"{method} gave {part} as {_kind(values)}, not uint8 {_shape(wanted)}")
    if int(cells[0].amax()) >= classes:
        raise _broken("scene model", model, f"{method} gave the class {int(cells[0].amax())} of {classes} classes")


def check_policy(policy: Any) -> None:
    """Raise ``PluginError`` when a policy needs no number of frames, or looks no number of actions ahead."""
    for member, value, lacking in (("frames", policy.frames, False), ("longest", policy.longest, True)):
        if not (lacking and value is None) and not (isinstance(value, int) and value >= 1):
            wanted = f"a number from 1 on{', or None' if lacking else ''}"
            raise _broken("policy", policy.name, f"its {member} is {value!r}, not {wanted}")


def check_proposals(proposed: Any, policy: str, known: Collection[str], horizon: int, count: int) -> None:
    """Raise ``PluginError`` when the proposals of a policy are not what ``Policy.propose`` promises.

    Args:
        proposed: what the policy returned.
        policy: its name.
        known: names of the actions that there are.
        horizon: the largest number of actions of a proposal.
        count: the number of proposals that was asked for.
    """
    if not isinstance(proposed, Sequence) or len(proposed) != count:
        given = f"{len(proposed)} of them" if isinstance(proposed, Sequence) else _kind(proposed)
        raise _broken("policy", policy, f"propose gave {given}, not {count} sequences of actions")
    for names in proposed:
        if isinstance(names, str) or not isinstance(names, Sequence):
            raise _broken("policy", policy, f"propose gave {names!r}, not a sequence of actions")
        if len(names) > horizon:
            raise _broken("policy", policy, f"propose gave {len(names)} actions of at most {horizon}")
        for name in names:
            if name not in known:
                raise _broken("policy", policy, f"propose gave the action {name!r}; known: {', '.join(known)}")


def check_costs(costs: Any, cost: str, shape: tuple[int, ...]) -> None:
    """Raise ``PluginError`` when costs are not what ``Cost.measure`` promises; NaN may come of imagined frames.

    Args:
        costs: what the cost returned.
        cost: its name.
        shape: candidates, and frames of each.
    """
    if not (isinstance(costs, Tensor) and costs.is_floating_point() and tuple(costs.shape) == shape):
        raise _broken("cost", cost, f"measure gave {_kind(costs)}, not float {_shape(shape)}")


def check_parameters(parameters: Any, model: str) -> None:
    """Raise ``PluginError`` when a model does not say which of its parameters are trained, or none is.

    Args:
        parameters: what ``trained_parameters`` returned.
        model: the name of the model's class.
    """
    if not isinstance(parameters, Mapping) or not all(isinstance(one, nn.Parameter) for one in parameters.values()):
        raise PluginError(f"{model}: trained_parameters gave {_kind(parameters)}, not parameters by name")
    if not parameters:
        raise PluginError(f"{model}: trained_parameters gave none; there is nothing to train in this stage")


def check_losses(losses: Any, model: str) -> None:
    """Raise ``PluginError`` when a model's ``forward`` does not give scalar tensors by name, ``loss`` among them.

    Args:
        losses: what the model returned.
        model: the name of its class.
    """
    what = f"{model}: forward gave"
    if not isinstance(losses, Mapping) or "loss" not in losses:
        raise PluginError(f"{what} {_kind(losses)}, not a mapping of scalar tensors with 'loss'")
    for name, value in losses.items():
        if not isinstance(value, Tensor) or value.ndim:
            raise PluginError(f"{what} {name} as {_kind(value)}, not a scalar tensor")
        if name in LOGGED:
            raise PluginError(f"{what} {name}, under which the log has something else; name it otherwise")
    if not losses["loss"].requires_grad:
        raise PluginError(f"{what} a loss without a gradient")


def is_finite(values: Tensor) -> bool:
    """Whether all of many numbers are finite; those without content are. A sum tells it soonest."""
    wide = torch.promote_types(values.dtype, torch.float32)  # a sum in half precision ends at 65504
    return values.is_meta or math.isfinite(float(values.sum(dtype=wide)))


def _is_length(value: Any) -> bool:
    """Whether something is a number of metres, 0 and infinity among them."""
    return isinstance(value, float | int) and value >= 0


def _is_place(value: Any) -> bool:
    """Whether something is three finite numbers."""
    is_triple = isinstance(value, tuple | list) and len(value) == 3
    return is_triple and all(isinstance(part, float | int) and math.isfinite(part) for part in value)


def _is_of(value: Any, dtype: torch.dtype, shape: tuple[int | None, ...]) -> bool:
    if not isinstance(value, Tensor) or value.dtype != dtype or value.ndim != len(shape):
        return False
    return all(size in (None, length) for size, length in zip(shape, value.shape, strict=True))


def _kind(value: Any) -> str:
    """A value in words: a tensor by its type and shape, anything else by its class."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {_shape(tuple(value.shape))}"
    return "None" if value is None else f"a {type(value).__name__}"


def _shape(sizes: tuple[object, ...]) -> str:
    return f"[{', '.join('…' if size is None else str(size) for size in sizes)}]"


def _broken(kind: str, name: str, cause: str) -> PluginError:
    return PluginError(f"{kind} {name!r}: {cause}", cause=cause)
