"""What a scene knows after some frames of a trajectory, by the same writing as in use; for training samples."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Final, Protocol

import numpy as np
import torch
from torch import Tensor

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.scene import Scene
from persist_cli.data.file_hashes import FileHashes
from persist_cli.data.store import TrajectoryFile
from persist_cli.data.stored_cells import CellBox, encode_cells
from persist_cli.errors import PluginError
from persist_cli.plugins import find_plugin, load_plugin, make_encoder, make_settings

MEMORY: Final = "scene"  # the plugin that is written
FORMAT: Final = 2  # of what is kept
MOST_KEPT: Final = 2000  # of the latest scenes, about 30 kB each, when there is no cache


class TensorStore(Protocol):
    """A cache of tensors by key, and of the hashes of files that they are made of."""

    hashes: FileHashes

    def get(self, key: str) -> dict[str, Tensor] | None:
        """Return the tensors of a key, ``None`` where they are not kept."""

    def put(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Keep tensors under a key."""


@dataclass(frozen=True)
class WrittenScene:
    """What a scene knows.

    Args:
        view: the newest frame.
        known: the cells in the smallest box that holds the known ones.
    """

    view: Observations
    known: CellGrid


class SceneWriter:
    """Writes frames into scenes, and keeps what they then know.

    Args:
        form: size and classes of the cells.
        cache: keeps what was written beyond this process; without it the latest scenes stay in memory.
    """

    def __init__(self, form: CellForm, cache: TensorStore | None = None) -> None:
        self.form, self.cache = form, cache
        self._hashes = FileHashes() if cache is None else cache.hashes
        self._latest: OrderedDict[str, dict[str, Tensor]] = OrderedDict()

    def scene(self, file: TrajectoryFile, frames: Sequence[int]) -> WrittenScene:
        """Return what a scene knows after these frames, of which the last is the newest.

        Raises:
            PluginError: when no memory ``scene`` is installed.
            DataError: when the trajectory is damaged.
        """
        key = self._key(file, frames)
        tensors = self._kept(key)
        seen = file.read(frames if tensors is None else [frames[-1]]).observations
        if tensors is None:
            known = self._write(file.info, seen)
            tensors = {
                "box": torch.tensor([*known.corner, *known.shape]),
                "cells": _to_tensor(encode_cells(known, None)),
            }
            self._keep(key, tensors)
        corner, shape = (tuple(int(n) for n in part) for part in (tensors["box"][:3], tensors["box"][3:]))
        box = CellBox(self.form, corner, shape)  # type: ignore[arg-type]
        return WrittenScene(seen[-1:], box.read([tensors["cells"].numpy().tobytes()], file.info.world_up))

    @cached_property
    def _encoder(self) -> Encoder:
        return make_encoder("classes", {"classes": len(self.form.palette)})

    @cached_property
    def _version(self) -> str:
        return find_plugin("memory", MEMORY).version

    @cached_property
    def _kind(self) -> type[Scene]:
        kind = load_plugin("memory", MEMORY)
        if not issubclass(kind, Scene):
            raise PluginError(f"memory {MEMORY!r} is no scene; samples of scenes are made with one")
        return kind

    @cached_property
    def _settings(self) -> Any:
        return make_settings("memory", MEMORY, self.form.to_json())

    def _write(self, info: TrajectoryInfo, seen: Observations) -> CellGrid:
        scene = self._kind(self._settings, self._encoder, FrameOfReference(info.scene, info.world_up))
        scene.memorize(seen)
        return scene.cells

    def _key(self, file: TrajectoryFile, frames: Sequence[int]) -> str:
        """A hash of all that a scene depends on."""
        depends = [FORMAT, self._version, asdict(self.form), self._hashes.of(file), *frames]
        return hashlib.sha256(json.dumps(depends).encode()).hexdigest()

    def _kept(self, key: str) -> dict[str, Tensor] | None:
        if self.cache is not None:
            return self.cache.get(key)
        if key in self._latest:
            self._latest.move_to_end(key)
        return self._latest.get(key)

    def _keep(self, key: str, tensors: dict[str, Tensor]) -> None:
        if self.cache is not None:
            self.cache.put(key, tensors)
            return
        self._latest[key] = tensors
        while len(self._latest) > MOST_KEPT:
            self._latest.popitem(last=False)


def _to_tensor(content: bytes | None) -> Tensor:
    return torch.from_numpy(np.frombuffer(content or b"", np.uint8).copy())
