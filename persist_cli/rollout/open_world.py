"""A world model put together from a checkpoint, one of its adapters and a memory, for ``rollout`` and for Python."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from persist_cli.api.checkpoint import PLAIN, REFERENCE, Checkpoint, find_checkpoint
from persist_cli.api.ground import Body
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.api.memory_file import read_header
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.api.scene import Scene
from persist_cli.checkpoints.load import adapter_memory, check_noise, check_video_model, empty_backbone, load_backbone
from persist_cli.data.clips import check_size
from persist_cli.data.reference import parse_reference
from persist_cli.errors import CheckpointError
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.memorize.memory_file import load_memory
from persist_cli.navigation.ground_mapper import body_of, tells_body
from persist_cli.output.console import busy, warn
from persist_cli.rollout.world_model import Agent, WorldModel


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """What a world model is put together with, beside its checkpoint and the data of its start.

    Args:
        start: the frame at which its agent begins, as errors name it.
        memory: a file that ``persist memorize`` wrote; an empty memory when ``None``.
        adapter: the memory adapter that was asked for by name; ``None`` where none was.
        write: whether what is imagined is written into the memory.
        seed: seed of the sampling noise.
        sampling: steps, sampler and guidance in place of the checkpoint's own.
        placement: precision and memory savings.
        body: whether walls stop the agent; ``None``: where the height of its camera is told, see ``tells_body``.
    """

    start: str
    memory: Path | None = None
    adapter: str | None = None
    write: bool = True
    seed: int = 0
    sampling: SamplingOverrides = field(default_factory=SamplingOverrides)
    placement: InferenceOptions = field(default_factory=InferenceOptions)
    body: bool | None = None


def open_world(
    start: str,
    checkpoint: Path | str = REFERENCE,
    adapter: str | None = None,
    memory: Path | str | None = None,
    sampling: SamplingOverrides | None = None,
    seed: int = 0,
) -> WorldModel:
    """Return a world model whose one agent stands at a frame of a data set, with a body if ``tells_body``.

    For example ``open_world("sample#0:32", memory="runs/house.safetensors").step([["left", "forward"]])``.

    Args:
        start: the frame, as in ``runs/houses#0:32``; ``sample`` is the data set that comes with the package.
        checkpoint: a run, an export or ``reference``, the model that comes with the package.
        adapter: name of a memory adapter, by default the checkpoint's default or only one; ``stage1`` for none.
        memory: a file that ``persist memorize`` wrote; an empty memory when ``None``.
        sampling: steps, sampler and guidance in place of the checkpoint's own.
        seed: seed of the sampling noise.

    Raises:
        PersistError: one line when one of them is missing or damaged, or they do not go together.
    """
    reference, found = parse_reference(start), find_checkpoint(Path(checkpoint))
    frame = reference.single().read([reference.frame])
    options = WorldOptions(
        start=start, memory=None if memory is None else Path(memory), adapter=adapter, seed=seed,
        sampling=sampling or SamplingOverrides(),
    )  # fmt: skip
    with torch.random.fork_rng(devices=[]):  # parts are drawn before they are loaded
        world = assemble_world(found, found.chosen_adapter(adapter), options, frame.info)
    world.reset([frame.observations], [frame.info])
    return world


def assemble_world(
    checkpoint: Checkpoint, adapter: str | None, options: WorldOptions, info: TrajectoryInfo
) -> WorldModel:
    """Return a world model with one agent, which has not begun yet.

    Args:
        checkpoint: the checkpoint.
        adapter: name of its adapter, ``None`` for the model without one.
        options: memory, seed, sampling and placement.
        info: scene, up axis and image size of the start frame's trajectory.

    Raises:
        PersistError: when model, memory, sampling and data do not go together.
    """
    with busy("loading the memory"):  # before the model, which takes longer, so that what cannot work fails at once
        memory = open_memory(checkpoint, adapter, options, info)
    with busy("loading the model"):
        return world_with(memory, checkpoint, adapter, options, info)


def world_with(
    memory: Memory | None, checkpoint: Checkpoint, adapter: str | None, options: WorldOptions, info: TrajectoryInfo
) -> WorldModel:
    """Return a world model whose one agent has a memory that is loaded already, and show no progress.

    Args:
        memory: what the agent remembers; it is moved to the model's device.
        checkpoint: the checkpoint.
        adapter: name of its adapter, ``None`` for the model without one.
        options: seed, sampling and placement.
        info: scene, up axis and image size of the start frame's trajectory.

    Raises:
        PersistError: when model, sampling and data do not go together.
    """
    check_video_model(checkpoint)
    empty, sampling = empty_backbone(checkpoint), checkpoint.sampling_with(options.sampling)
    check_size(info, empty.image_size, options.start)
    empty.check_sampling(sampling)
    check_noise(sampling, [checkpoint])
    backbone = load_backbone(checkpoint, adapter=adapter)
    backbone.prepare_inference(options.placement)
    agent = Agent(memory and memory.placed(backbone.device), options.seed, options.write, body=body_for(options, info))
    return WorldModel(backbone, [agent], sampling)


def body_for(options: WorldOptions, info: TrajectoryInfo) -> Body | None:
    """Return the body of a world's agent, ``None`` for a camera that nothing stops."""
    collides = tells_body(info) if options.body is None else options.body
    return body_of(info) if collides else None


def open_memory(
    checkpoint: Checkpoint, adapter: str | None, options: WorldOptions, info: TrajectoryInfo
) -> Memory | None:
    """Return the memory of the options' file, else an empty one of the adapter's kind, ``None`` without an adapter."""
    empty = empty_memory(checkpoint, adapter, options, info)
    if empty is None or options.memory is None:
        return empty
    check_memory(read_header(options.memory), empty, checkpoint, options.memory)
    memory = load_memory(options.memory)
    check_cells(memory, empty, options.memory)
    warn_of_settings(memory, empty, options.memory)
    return memory


def empty_memory(
    checkpoint: Checkpoint, adapter: str | None, options: WorldOptions, info: TrajectoryInfo
) -> Memory | None:
    """Return an empty memory of the adapter's kind, ``None`` without an adapter, which reads no file."""
    if adapter is not None:
        return MemoryFactory.of_adapter(checkpoint, adapter).empty(info)
    if options.memory is not None:
        without = f"--adapter {PLAIN} is the model" if options.adapter else f"{checkpoint.folder}: is a model"
        raise CheckpointError(f"{without} without a memory adapter, which cannot read {options.memory}")
    return None


def check_cells(memory: Memory, wanted: Memory, path: Path) -> None:
    """Raise ``CheckpointError`` when a scene has other cells than the one that the adapter reads.

    Args:
        memory: the memory of a file.
        wanted: an empty memory as the adapter reads it.
        path: the file.
    """
    if not isinstance(memory, Scene) or not isinstance(wanted, Scene) or memory.cells.form == wanted.cells.form:
        return
    own, its = memory.cells.form, wanted.cells.form
    if own.size != its.size:
        raise CheckpointError(f"{path}: its cells are {own.size:g} m wide, those that the adapter draws {its.size:g} m")
    other = sorted({*own.palette} ^ {*its.palette}) or ["their order"]
    raise CheckpointError(
        f"{path}: its classes of cells are not those that the adapter draws; they differ in {', '.join(other)}"
    )


def warn_of_settings(memory: Memory, wanted: Memory, path: Path) -> None:
    """Warn when a memory was made with other settings than those that the adapter was made for.

    Args:
        memory: the memory of a file.
        wanted: an empty memory as the adapter reads it.
        path: the file.
    """
    own, its = asdict(memory.settings), asdict(wanted.settings)
    other = [name for name, value in own.items() if name not in memory.changeable and value != its.get(name)]
    if other:
        settings = ", ".join(f"memory.{name} is {own[name]}, there {its.get(name)}" for name in other)
        warn(f"{path}: made with other settings than the adapter's, which may draw it worse: {settings}")


def check_memory(header: Mapping[str, Any], wanted: Memory, checkpoint: Checkpoint, path: Path) -> None:
    """Raise ``CheckpointError`` when a memory file differs from the kind or scene that the adapter reads.

    Args:
        header: header of the file.
        wanted: an empty memory as the adapter reads it.
        checkpoint: the checkpoint, whose other adapters may read the file.
        path: the file.
    """
    expected = json.loads(json.dumps(wanted.header()))
    for key in ("memory", "encoder", "encoder_settings", "channels", "reference"):
        if header[key] != expected[key]:
            name = key.replace("_", " ")
            readers = [one for one in checkpoint.adapters if adapter_memory(checkpoint, one).name == header["memory"]]
            advice = f"; --adapter {readers[0]} reads it" if key == "memory" and readers else ""
            raise CheckpointError(f"{path}: its {name} is {header[key]!r}, wanted here is {expected[key]!r}{advice}")
