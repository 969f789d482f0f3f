"""A walk with the keys put together from a checkpoint, its adapters, a start and what is remembered there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import ONE_STEP, PLAIN, Checkpoint, find_checkpoint
from persist_cli.api.inference import CONSISTENCY, InferenceOptions, SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.api.memory_file import is_memory_file, read_header
from persist_cli.api.observations import Trajectory
from persist_cli.checkpoints.load import (
    adapter_memory,
    check_video_model,
    empty_backbone,
    load_adapter,
    load_backbone,
    warn_of_plain,
)
from persist_cli.checkpoints.placement import check_placement
from persist_cli.data.clips import check_size
from persist_cli.errors import CheckpointError, DataError
from persist_cli.memorize.sources import Source, find_sources
from persist_cli.output.console import busy
from persist_cli.play.play import Play
from persist_cli.play.settings import PlaySettings
from persist_cli.play.start import SAMPLE_FRAMES, StartOptions, read_start
from persist_cli.play.walkers import AdaptedWorld
from persist_cli.rollout.open_world import body_for, open_memory
from persist_cli.rollout.world_model import Agent


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """What is walked in.

    Args:
        checkpoint: a run, an export or the name of a packaged model: ``reference``, or ``reference-1step``, which
            predicts a clip in one step.
        begin: where the walk begins, and with which actions.
        memories: names of the checkpoint's adapters, or ``stage1`` for none, in the order in which they are shown. The
            first one decides what is in the way. Without any it is the checkpoint's default.
        given: what is remembered at the start: memory files, each for the adapters that read it, and frames of data,
            as in ``runs/houses#0:0-33``, for all.
        settings: how frames are imagined.
        placement: precision and memory savings.
        own_steps: whether a distilled model takes as many denoising steps as its checkpoint asks for, in the place of
            those of the settings.
    """

    checkpoint: Path | str = ONE_STEP
    begin: StartOptions = field(default_factory=StartOptions)
    memories: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    settings: PlaySettings = field(default_factory=PlaySettings)
    placement: InferenceOptions = field(default_factory=InferenceOptions)
    own_steps: bool = False


def open_play(options: PlayOptions) -> Play:
    """Return a walk that stands at its start, in one world model for each memory.

    For example ``open_play(PlayOptions(memories=("voxel", "none"))).advance({"forward"})``.

    Raises:
        PersistError: one line when something is missing or damaged, or does not go together.
    """
    return open_walks(options)()


def open_walks(options: PlayOptions) -> Callable[[], Play]:
    """Return what makes walks from one start that share a model, as several people walk at once; one acts at a time.

    Raises:
        PersistError: as ``open_play``; what it returns raises it where the settings are wrong.
    """
    check_placement(options.placement)  # a missing accelerator is an error before anything is loaded
    if is_memory_file(options.begin.start) and options.begin.start not in options.given:
        options = replace(options, given=(options.begin.start, *options.given))
    checkpoint = find_checkpoint(Path(options.checkpoint))
    names = chosen_memories(checkpoint, options.memories)
    size, scenes = empty_backbone(checkpoint).image_size, checkpoint.training_scenes
    start = read_start(options.begin, size, None if scenes is None else scenes.fov)
    check_video_model(checkpoint)
    check_size(start.info, size, options.begin.start)
    with busy("loading the memories"):  # before the model, so that what cannot work fails at once
        memories = {name: _memory(checkpoint, name, options, start) for name in names}
        _memorize(find_given(options.given, checkpoint, names), memories, start)
    with busy("loading the model"):
        backbone = _load(checkpoint, names)
    backbone.prepare_inference(options.placement)
    placed = {name: memory and memory.placed(backbone.device) for name, memory in memories.items()}
    sampling, body = checkpoint.sampling_with(SamplingOverrides()), body_for(options.begin.world, start.info)
    settings = options.settings
    if options.own_steps and sampling.sampler == CONSISTENCY:
        settings = replace(settings, steps=sampling.steps)
    if PLAIN in names:
        warn_of_plain(checkpoint, sampling)

    def walk() -> Play:
        worlds: dict[str, AdaptedWorld] = {}
        for name, memory in placed.items():  # each walk writes into copies
            agent = Agent(memory, body=None if worlds else body)
            worlds[name] = AdaptedWorld(backbone, [agent], sampling, None if name == PLAIN else name)
        return Play(worlds, start, settings, checkpoint.name)

    return walk


def chosen_memories(checkpoint: Checkpoint, names: Sequence[str]) -> tuple[str, ...]:
    """Return the adapters that are named, each once, else the checkpoint's default; ``stage1`` where it has none.

    Raises:
        CheckpointError: when it has no such adapter, or several and no default.
    """
    for name in names:
        if name != PLAIN:
            checkpoint.adapter_folder(name)
    return tuple(dict.fromkeys(names)) or (checkpoint.default_adapter() or PLAIN,)


def find_given(given: Sequence[str], checkpoint: Checkpoint, names: Sequence[str]) -> list[Source]:
    """Return the frames among what is given.

    Raises:
        PersistError: when a memory file is read by none of the adapters, or frames are not there.
    """
    kinds = {adapter_memory(checkpoint, name).name for name in names if name != PLAIN}
    for text in filter(is_memory_file, given):
        kind = read_header(Path(text))["memory"]
        if kind not in kinds:
            readers = [one for one in checkpoint.adapters if adapter_memory(checkpoint, one).name == kind]
            advice = f"add {readers[0]!r} to --memories" if readers else "no adapter of this model does"
            raise CheckpointError(f"{text}: a memory of kind {kind!r}, which {', '.join(names)} cannot read; {advice}")
    frames = [text for text in given if not is_memory_file(text)]
    if not kinds and any(text != SAMPLE_FRAMES for text in frames):
        raise CheckpointError(f"{frames[0]}: {PLAIN} remembers no frames; name another memory in --memories")
    return find_sources(frames) if frames else []


def _memory(checkpoint: Checkpoint, name: str, options: PlayOptions, start: Trajectory) -> Memory | None:
    """Return the memory of an adapter: of the given file of its kind, else an empty one; ``None`` without adapter."""
    if name == PLAIN:
        return None
    kind = adapter_memory(checkpoint, name).name
    files = [Path(text) for text in options.given if is_memory_file(text) and read_header(Path(text))["memory"] == kind]
    if len(files) > 1:
        raise CheckpointError(
            f"{files[1]}: a second memory of kind {kind!r}; give one, or `persist memorize --merge` them"
        )
    return open_memory(checkpoint, name, replace(options.begin.world, memory=files[0] if files else None), start.info)


def _memorize(sources: Sequence[Source], memories: dict[str, Memory | None], start: Trajectory) -> None:
    """Write given frames into all memories."""
    for source in sources:
        scene = source.file.info.scene
        if scene != start.info.scene:
            raise DataError(f"{source.text}: is of scene {scene!r}, the start of {start.info.scene!r}; name one scene")
        for piece in source.pieces():
            for memory in memories.values():
                if memory is not None:
                    memory.memorize(piece)


def _load(checkpoint: Checkpoint, names: Sequence[str]) -> Backbone:
    """Return the backbone with all adapters."""
    first, *others = [None if name == PLAIN else name for name in names]
    backbone = load_backbone(checkpoint, adapter=first)
    for name in others:
        load_adapter(backbone, checkpoint, name)
    return backbone
