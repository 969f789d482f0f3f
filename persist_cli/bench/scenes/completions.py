"""Rows of the benchmark: ways to say what is in the cells that an image does not show."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.api.cells import FREE, OUTSIDE, CellGrid
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.api.scene import Scene
from persist_cli.api.scene_model import SceneModel
from persist_cli.bench.scenes.training_houses import (
    House,
    Match,
    class_frequencies,
    nearest_houses,
    region_of_match,
    vote,
)
from persist_cli.bench.scenes.views import Region, View, filled, same_form, true_region
from persist_cli.errors import PersistError
from persist_cli.memorize.factory import MemoryFactory

MOST: Final = 5  # houses that vote


class Completion(ABC):
    """Fills the unknown cells around a view."""

    name: ClassVar[str]
    definition: ClassVar[str]
    random: ClassVar[bool] = False  # whether another seed gives another completion

    def prepare(self, views: Sequence[View]) -> None:  # noqa: B027  # most have nothing to prepare
        """Look at all views before the first is completed."""

    @abstractmethod
    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return the view's region with its known cells as they are.

        Args:
            view: an image and what is known after it; its truth must not be read, but by the row ``truth``.
            number: of the view among those that ``prepare`` was given.
            seed: of random completions.
        """


class Truth(Completion):
    """The true cells: the ceiling."""

    name = "truth"
    definition = "the true cells, the ceiling"

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return the true cells where nothing is known."""
        return filled(view.known, view.truth.classes)


class CodedTruth(Completion):
    """The true cells, through the codec of a scene model: the ceiling of what it can imagine.

    Args:
        scenes: with the model.
    """

    name = "truth, coded"
    definition = "the true cells, through the codec of the scene model: the ceiling of what it can imagine"

    def __init__(self, scenes: Scenes) -> None:
        self.scenes = scenes

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return what comes out of the codec where nothing is known, window by window."""
        model, region = self.scenes.model, view.region
        assert model is not None
        classes, size = view.truth.classes.clone(), model.form.shape
        for first in range(0, region.shape[0], size[0]):
            for second in range(0, region.shape[1], size[1]):
                corner = (region.corner[0] + first, region.corner[1] + second, region.corner[2])
                window = true_region(view.house, Region(corner, size, 0))
                cells = (values[None].to(self.scenes.factory.device) for values in (window.classes, window.colors))
                came = model.reconstruct(*cells)[0][0].cpu()
                part = classes[first : first + size[0], second : second + size[1], : size[2]]
                part.copy_(came[tuple(slice(length) for length in part.shape)])
        return filled(view.known, classes)


class Empty(Completion):
    """Nothing anywhere."""

    name = "empty"
    definition = "every unknown cell is free"

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return free cells where nothing is known."""
        return filled(view.known, torch.full_like(view.known.classes, FREE))


class Outside(Completion):
    """No room anywhere."""

    name = "outside"
    definition = "every unknown cell is outside"

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return cells outside where nothing is known."""
        return filled(view.known, torch.full_like(view.known.classes, OUTSIDE))


class Prior(Completion):
    """The most frequent class of each cell around cameras of the training.

    Args:
        houses: of the training.
    """

    name = "class prior"
    definition = (
        "the most frequent class of each cell around 8 cameras of each training house; cells are counted in the "
        "camera's place, the house turned by quarter turns so that the camera looks along the first ground axis"
    )

    def __init__(self, houses: Sequence[House]) -> None:
        self.houses = houses
        self.classes: dict[tuple[int, int, int, int], UInt8[Tensor, "first second level"]] = {}

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return the most frequent classes."""
        key = (*view.region.shape, view.region.corner[2])
        if key not in self.classes:
            frequencies = class_frequencies(self.houses, view.region, view.truth.form)
            self.classes[key] = frequencies.argmax(-1).to(torch.uint8)
        return filled(view.known, view.region.back(self.classes[key]))


class HouseSearch:
    """Looks for training houses that agree with what is known, once for all rows.

    Args:
        houses: of the training.
    """

    def __init__(self, houses: Sequence[House]) -> None:
        self.houses = houses
        self.matches: list[list[Match]] = []  # of each view, the best one first
        self._views: Sequence[View] = ()

    def look(self, views: Sequence[View]) -> None:
        """Find the ``MOST`` best houses of each view."""
        if views is not self._views:
            self.matches, self._views = nearest_houses(views, self.houses, MOST), views


class NearestHouse(Completion):
    """The training house that agrees best with what is known.

    Args:
        search: of training houses.
    """

    name = "nearest house"
    definition = (
        "the training house in which most known cells agree on being free or not, over four turns and all shifts by "
        "whole cells; beyond it all is outside"
    )

    def __init__(self, search: HouseSearch) -> None:
        self.search = search

    def prepare(self, views: Sequence[View]) -> None:
        """Find the house of each view."""
        self.search.look(views)

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return what is in the house at that place."""
        return filled(view.known, region_of_match(self.search.matches[number][0], self.search.houses, view.region))


class NearestHouses(NearestHouse):
    """What most of the training houses have that agree best with what is known."""

    name = f"{MOST} nearest houses"
    definition = f"what most of the {MOST} training houses have that agree best, each as the nearest house"

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return what most of the houses have at that place."""
        search, classes = self.search, len(view.truth.form.palette)
        return filled(view.known, vote(search.matches[number], search.houses, view.region, classes))


class SceneCompletion(Completion):
    """A scene with a model, to which the image is written as a user would.

    Args:
        scenes: with the model.
    """

    name = "model"
    definition = "the scene model, from the image with its depth and the cells that it shows"
    random = True

    def __init__(self, scenes: Scenes) -> None:
        self.scenes = scenes

    def complete(self, view: View, number: int, seed: int) -> CellGrid:
        """Return what the scene imagines in the region."""
        scene = self.scenes.after(view)
        scene.complete(view.region.box(view.truth), seed)
        return same_form(view.region.of(scene.cells), view.truth.form, "the scene model")


CEILINGS: Final = (CodedTruth.name, Truth.name)  # rows that read the truth, which nothing is compared with


@dataclass(frozen=True)
class Scenes:
    """Makes the scenes of the benchmark.

    Args:
        factory: of memories that are scenes.
        model: imagines their unknown cells; ``None`` for none.
    """

    factory: MemoryFactory
    model: SceneModel | None

    def empty(self, info: TrajectoryInfo) -> Scene:
        """Return an empty scene in the world of a trajectory.

        Raises:
            PersistError: when the memory is no scene.
        """
        memory, model = self.factory.empty(info), self.model
        if not isinstance(memory, Scene):
            raise PersistError(f"memory {memory.name!r} is no scene: it imagines nothing; take the memory 'scene'")
        memory.imagine_with(None if model is None else lambda: model)
        return memory

    def seeded(self, seed: int) -> Scenes:
        """Return the same with another seed of what scenes imagine while an agent walks."""
        settings = replace(self.factory.settings, seed=seed)
        return replace(self, factory=replace(self.factory, settings=settings))

    def after(self, view: View) -> Scene:
        """Return a scene that holds one image."""
        scene = self.empty(view.info)
        scene.memorize(view.frame.to(self.factory.device))
        return scene
