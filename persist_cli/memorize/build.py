"""``persist memorize``: write posed RGB-D into a memory file, or merge several memory files."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cell_things import floor_level
from persist_cli.api.memory import Memory
from persist_cli.api.scene import Scene
from persist_cli.errors import CheckpointError, DataError, FrameError, PersistError
from persist_cli.io.command_line import quoted
from persist_cli.io.files import check_folder, empty_folder_aside, remove_leftovers
from persist_cli.memorize.imagining import of_known_cells, with_scene_model
from persist_cli.memorize.memory_config import MemorizePlan, reading_adapter, resolve_memory_config, with_usual_classes
from persist_cli.memorize.memory_file import add_paths, load_memory, load_paths
from persist_cli.memorize.picture import PictureOptions, is_picture, refuse_picture_options, take_place, write_picture
from persist_cli.memorize.sources import Source, common_reference, find_sources
from persist_cli.output.console import add_task, busy, print_json, print_table, progress, say, warn, watched
from persist_cli.output.map import draw_map
from persist_cli.plugins import load_plugin, make_encoder, make_memory
from persist_cli.recipe import MemoryConfig

NEAR_FLOOR = 2  # cells: no camera is expected lower, and the floor that was seen may be so far off


def run_memorize(data: list[str], plan: MemorizePlan, picture: PictureOptions, out: Path, json: bool) -> None:
    """Write the memory of some frames and its map from above, and print its size.

    A picture becomes a data set of one frame beside the memory, where a rollout can start.

    Args:
        data: references to frames of one scene, as in ``runs/houses#0:0-48``, or a picture.
        plan: name and settings of the memory and its encoder, and whether it is completed.
        picture: what is known of the picture.
        out: memory file to write; the map is written beside it as PNG.
        json: whether JSON is printed instead of a table.
    """
    _check_out(out)
    config, origin = resolve_memory_config(plan)
    check_imagines(config, plan)
    with _with_picture(data, picture, out) as references:
        sources = find_sources(references)
        memory, extra = _built(sources, config, plan, origin)
        map_file = out.with_suffix(".png")
        if is_picture(data[0]):
            given = [Path(data[0]), *([] if picture.depth is None else [picture.depth])]
            if map_file.exists() and any(map_file.samefile(path) for path in given):
                map_file = out.with_suffix(".map.png")  # neither is replaced by the map of the scene
            extra["start"] = f"{_frame_folder(out)}#{sources[0].file.name}:0"
        _save_and_print(memory, _paths(sources), (out, map_file), json, extra)
    if "start" in extra and not json:
        say(walking_words(memory.name, out, str(extra["start"]), plan.checkpoint))


def _built(
    sources: Sequence[Source], config: MemoryConfig, plan: MemorizePlan, origin: str | None
) -> tuple[Memory, dict[str, Any]]:
    """The memory of the sources, and what is said of it beside its size."""
    asked = origin is None or plan.checkpoint is not None
    config = with_usual_classes(of_known_cells(config, sources[0].file, asked))
    with busy("loading the encoder"):
        encoder = make_encoder(config.encoder, config.encoder_settings)
    memory = with_scene_model(make_memory(config.name, config.settings, encoder, common_reference(sources)))
    scene = imagining_scene(memory) if plan.complete else None
    seconds = write_sources(memory, sources)
    frames = sum(len(source.frames) for source in sources)
    extra = {"frames": frames, "frames_per_second": frames / seconds, "settings_of": origin}
    if scene is not None:
        newest = sources[-1]
        _check_floor(scene, config, newest.file.poses()[newest.frames.stop - 1])
        began = time.perf_counter()
        with busy("imagining"):
            seed = config.settings.get("seed", 0) if plan.seed is None else plan.seed
            extra["completed"] = scene.complete(seed=seed)
        extra["seconds_imagining"] = time.perf_counter() - began
    return memory, extra


def _paths(sources: Sequence[Source]) -> dict[str, Tensor]:
    """The poses of all frames that were written, by trajectory."""
    paths: dict[str, Tensor] = {}
    for source in sources:
        add_paths(paths, {source.file.name: source.file.poses()[source.frames.start : source.frames.stop]})
    return paths


@contextlib.contextmanager
def _with_picture(data: list[str], options: PictureOptions, out: Path) -> Iterator[list[str]]:
    """References to data; a picture is written as a data set, which is put beside the memory when the block ends well.

    Other pictures that are there are removed then, since frame 0 of the folder is where a walk starts.
    """
    pictures = [text for text in data if is_picture(text)]
    if not pictures:
        refuse_picture_options(options)
        yield data
        return
    if len(data) > 1:
        raise DataError(f"{pictures[0]}: a scene of a picture is made of one picture, here are {len(data)}")
    folder = _frame_folder(out)
    remove_leftovers(folder.parent, folder.name)
    with empty_folder_aside(folder) as aside:
        written = write_picture(Path(pictures[0]), options, aside)
        yield [str(aside)]
        take_place(written, folder)


def _frame_folder(out: Path) -> Path:
    """Where the data set of a memory's picture is."""
    return out.with_suffix(".frame")


def check_imagines(config: MemoryConfig, plan: MemorizePlan) -> None:
    """Raise ``PersistError`` where a memory is to imagine that is no scene, or a seed is given for nothing."""
    kind = config.name
    if issubclass(load_plugin("memory", kind), Scene):
        if plan.seed is not None and not plan.complete and config.settings.get("model") is None:
            raise PersistError("--seed: this scene has no model that imagines; add --complete or --model")
        return
    if plan.complete:
        raise PersistError(f"--complete: a memory of kind {kind!r} imagines nothing; take --memory scene")
    if plan.seed is not None:
        raise PersistError(f"--seed: a memory of kind {kind!r} imagines nothing; leave it out")


def imagining_scene(memory: Memory) -> Scene:
    """Return a scene that can be completed.

    Raises:
        CheckpointError: when it has no model.
    """
    assert isinstance(memory, Scene)
    memory.model()
    return memory


def _check_floor(scene: Scene, config: MemoryConfig, world_from_camera: Float[Tensor, "4 4"]) -> None:
    """Warn where a camera stands on or below the floor of what will be imagined, or above its ceiling."""
    level, form = floor_level(scene.cells), scene.model().form
    if level is None:
        return
    size, floor = form.cells.size, config.settings.get("floor", 0.0)
    seen = (scene.cells.corner[2] + level) * size
    height = float(scene.cells.axes[2] @ world_from_camera[:3, 3].double())
    near = NEAR_FLOOR * size
    if not near < height - floor < form.shape[2] * size and abs(seen - floor) > near:
        warn(
            f"warning: what is imagined has its floor at {floor:g} m along up, and the camera is at {height:.2f} m; "
            f"what was seen has its floor near {seen:g} m: --set memory.floor={seen:g}"
        )


def run_merge(paths: list[Path], out: Path, json: bool) -> None:
    """Write the union of several memory files of one scene and its map from above, and print its size.

    Args:
        paths: memory files, at least two.
        out: memory file to write; the map is written beside it as PNG.
        json: whether JSON is printed instead of a table.
    """
    if len(paths) < 2:
        raise PersistError("nothing to merge; name two memory files or more, as in --merge A B")
    _check_out(out)
    merged, walked = load_memory(paths[0]), load_paths(paths[0])
    for path in watched(paths[1:], "merging", "memories"):
        try:
            merged.merge(load_memory(path))
        except CheckpointError as error:
            raise CheckpointError(f"{paths[0]} and {path}: {error}") from error
        add_paths(walked, load_paths(path))
    _save_and_print(merged, walked, (out, out.with_suffix(".png")), json, {"merged": len(paths)})


def write_sources(memory: Memory, sources: Sequence[Source]) -> float:
    """Write all frames into the memory, a few at a time, and return the duration in seconds.

    That the memory can be read again is checked after the first of them, not after hours.

    Raises:
        PluginError: when it cannot.
        DataError: naming the trajectory and the frame that the memory cannot take.
    """
    start = time.perf_counter()
    with progress() as bar:
        task = add_task(bar, "memorizing", sum(len(source.frames) for source in sources), "frames")
        for source in sources:
            bar.update(task, note=source.file.name)
            first = source.frames.start
            for piece in source.pieces():
                try:
                    memory.memorize(piece)
                except FrameError as error:
                    raise DataError(f"{source.file.path}: frame {first + error.frame}: {error.cause}") from error
                if first == sources[0].frames.start and source is sources[0]:
                    memory.check_copy()
                first += len(piece)
                bar.advance(task, len(piece))
    return time.perf_counter() - start


def _save_and_print(
    memory: Memory, paths: Mapping[str, Tensor], files: tuple[Path, Path], json: bool, extra: dict[str, Any]
) -> None:
    """Write a memory and its map into the two files, and print its size."""
    out, map_file = files
    for path in (out, map_file):
        remove_leftovers(path.parent, path.name)
    with busy("writing the memory and its map"):
        memory.save(out, paths)
        draw_map(memory.points(), memory.reference.world_up, paths, map_file)
    figures = memory.figures()
    result = {
        "file": str(out),
        "map": str(map_file),
        "memory": memory.name,
        "encoder": memory.encoder.name,
        "channels": memory.encoder.channels,
        "scene": memory.reference.name,
        "cells": figures.cells,
        "observed": figures.observed,
        "imagined": figures.imagined,
        "bytes": figures.bytes,
        "bounds": figures.bounds,
        **extra,
    }
    if json:
        print_json(result)
    else:
        print_table(f"memory of {memory.reference.name}", ["", "value"], _table_rows(result))
        if extra.get("settings_of"):
            say(f"settings and encoder: those of {extra['settings_of']}")
        say(f"memory: {out}\nmap: {map_file}")


def walking_words(memory: str, out: Path, start: str, checkpoint: Path | None) -> str:
    """Return the command that walks in the memory of a picture, by default with the packaged world model."""
    adapter = reading_adapter(checkpoint, memory)
    if adapter is None:
        name = "the packaged model" if checkpoint is None else str(checkpoint)
        return f"to walk in it, train an adapter that reads a memory {memory!r}: {name} has none"
    model = [] if checkpoint is None else [str(checkpoint)]
    walk = " ".join(map(quoted, [*model, "--adapter", adapter, "--start", start, "--memory", str(out)]))
    return f'walk in it: persist rollout {walk} --actions "right*6"'


def _table_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and values for people, without paths: digits of large numbers in groups, bounds as ranges."""
    texts = {name: value for name, value in result.items() if name not in ("file", "map", "settings_of", "start")}
    texts["bytes"] = f"{result['bytes']:,}"
    texts |= {name: f"{result[name]:,}" for name in ("cells", "observed", "imagined")}
    if result["bounds"] is None:
        texts["bounds"] = "empty"
    else:
        ranges = [f"{low:.2f}…{high:.2f}" for low, high in zip(*result["bounds"], strict=True)]
        texts["bounds"] = " × ".join(ranges) + " m"
    if "frames_per_second" in result:
        texts["frames_per_second"] = f"{result['frames_per_second']:.3g}"
    if "seconds_imagining" in result:
        texts["seconds_imagining"] = f"{result['seconds_imagining']:.2f}"
    return [(name.replace("_per_second", "/s"), str(value)) for name, value in texts.items()]


def _check_out(out: Path) -> None:
    check_folder(out.parent)
    if out.is_dir() or out.suffix == ".png":
        raise PersistError(f"{out}: name a file to write, as in memory.safetensors (its map is drawn to .png)")
