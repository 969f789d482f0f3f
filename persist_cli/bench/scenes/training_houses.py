"""What the houses of the training say of a house never seen: the most alike of them, and how often a cell is what."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cells import CellForm, CellGrid, is_solid
from persist_cli.bench.scenes.views import Region, View, same_form, true_region
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.output.console import add_task, progress

AT_ONCE = 16  # views that are compared with a house together
POSES = 8  # of each training house that say how often a cell is what


@dataclass(frozen=True)
class House:
    """A house of the training.

    Args:
        scene: its name.
        cells: all of its cells at the start.
        poses: some cameras in it, ``world_from_camera``.
        sha256: of the file that it was read from.
    """

    scene: str
    cells: CellGrid
    poses: Float[Tensor, "pose 4 4"]
    sha256: str = ""


@dataclass(frozen=True)
class Match:
    """The place of a training house in a view's region at which most of the known cells agree.

    Args:
        scene: name of the house.
        house: its number.
        turns: quarter turns from the first ground axis towards the second by which the region is turned to fit.
        shift: column of the house in which the corner of the turned region lies; it may be negative.
        agreement: share of the view's known cells that are free or not as the house's are.
    """

    scene: str
    house: int
    turns: int
    shift: tuple[int, int]
    agreement: float


def read_houses(store: Store, most: int, form: CellForm) -> list[House]:
    """Read different houses of a data set, each once.

    Args:
        store: a data set with cells.
        most: houses that are read, evenly spread over the data set.
        form: size and classes that they must have.

    Raises:
        DataError: when a file has no cells, or others.
    """
    by_scene: dict[str, TrajectoryFile] = {}
    for file in store:
        by_scene.setdefault(file.info.scene, file)
    files = list(by_scene.values())
    chosen = np.unique(np.linspace(0, len(files) - 1, min(most, len(files))).round().astype(int))
    houses = []
    with progress() as bar:
        task = add_task(bar, "reading houses of the training", len(chosen), "houses")
        for number in chosen:
            file = files[number]
            spread = np.unique(np.linspace(0, len(file) - 1, POSES).round().astype(int))
            cells = same_form(file.cells(0), form, str(file.path))
            houses.append(House(file.info.scene, cells, file.poses()[spread], file.sha256))
            bar.advance(task)
    return houses


def nearest_houses(views: Sequence[View], houses: Sequence[House], count: int = 1) -> list[list[Match]]:
    """Return for each view the training houses whose cells agree most with the known ones, each in its best place.

    Every house is tried in four turns at every shift by whole columns; beyond it all counts as not free. Only whether a
    cell is free is compared, since an image does not tell classes. Of equal ones the first comes first.

    Args:
        views: all with regions of one shape.
        houses: at least one.
        count: most houses of a view.
    """
    side = views[0].region.shape[0]
    size = side + max(max(house.cells.shape[:2]) for house in houses)
    best: list[list[Match]] = [[] for _ in views]
    with progress() as bar:
        task = add_task(bar, "looking for houses that are alike", len(houses), "houses")
        spectra = [*_view_spectra(views, size)]
        for number, house in enumerate(houses):
            spectrum = torch.fft.rfft2(_signs(house.cells, views[0].region).float() - 1, (size, size))
            for first, known, counts in spectra:
                for view, place in enumerate(_best_places(known, counts, spectrum, size), first):
                    found = [*best[view], _named(place, number, house, size)]
                    best[view] = sorted(found, key=lambda match: -match.agreement)[:count]
            bar.advance(task)
    return best


def vote(
    matches: Sequence[Match], houses: Sequence[House], region: Region, classes: int
) -> UInt8[Tensor, "first second level"]:
    """Return what most of the matched houses have in a view's region; of as many the class of the least number.

    Args:
        matches: of the view.
        houses: of the training.
        region: of the view.
        classes: number of classes.
    """
    votes = torch.zeros(*region.shape, classes)
    for match in matches:
        said = region_of_match(match, houses, region).long()[..., None]
        votes.scatter_add_(3, said, torch.ones(said.shape))
    return votes.argmax(-1).to(torch.uint8)


@dataclass(frozen=True)
class _Place:
    """Turns of a view's region, and the shift in the house that fits best then."""

    turns: int
    shift: tuple[int, int]
    agreement: float


def _signs(cells: CellGrid, region: Region) -> Float[Tensor, "level first second"]:
    """Return 1 for cells of the region's levels that are not free, -1 for free ones, beyond the house 1."""
    levels = cells.box((*cells.corner[:2], region.corner[2]), (*cells.shape[:2], region.shape[2]))
    free = levels.known & (levels.classes == 0)
    return torch.where(free, -1.0, 1.0).permute(2, 0, 1)


def _view_spectra(views: Sequence[View], size: int) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Yield the number of the first of some views, the spectra of their known cells in four turns, and their counts."""
    for first in range(0, len(views), AT_ONCE):
        some = views[first : first + AT_ONCE]
        signs = torch.stack([_known_signs(view) for view in some])
        turned = torch.stack([torch.rot90(signs, turns, (1, 2)) for turns in range(4)], 1)
        spectra = torch.fft.rfft2(turned.permute(0, 1, 4, 2, 3), (size, size)).conj()
        yield first, spectra, torch.stack([signs.sum((1, 2, 3)), signs.abs().sum((1, 2, 3))], -1)


def _known_signs(view: View) -> Float[Tensor, "first second level"]:
    occupied = torch.where(is_solid(view.known.classes), 1.0, -1.0)
    return torch.where(view.known.known, occupied, 0.0)


def _best_places(spectra: Tensor, counts: Tensor, house: Tensor, size: int) -> Iterator[_Place]:
    """Yield the best place of a house for each of some views.

    A correlation gives agreements minus disagreements for every shift at once.

    Args:
        spectra: ``[view, turn, level, ...]`` of known cells, conjugated.
        counts: ``[view, 2]``: sum of the signs of known cells, and their number.
        house: spectrum of the house's signs minus 1, ``[level, ...]``.
        size: of the transform.
    """
    products = torch.einsum("vtlij,lij->vtij", spectra, house)
    scores = torch.fft.irfft2(products, (size, size)).round() + counts[:, 0, None, None, None]
    for score, (_, known) in zip(scores, counts.tolist(), strict=True):
        turns, first, second = np.unravel_index(int(score.argmax()), score.shape)
        agreement = (float(score.max()) + known) / (2 * max(known, 1.0))
        yield _Place(int(turns), (int(first), int(second)), agreement)


def _named(place: _Place, number: int, house: House, size: int) -> Match:
    """Return a place in a house as a match; the transform is cyclic, so shifts beyond the house are negative."""
    pairs = zip(place.shift, house.cells.shape[:2], strict=True)
    first, second = (shift if shift < length else shift - size for shift, length in pairs)
    return Match(house.scene, number, place.turns, (first, second), place.agreement)


def region_of_match(match: Match, houses: Sequence[House], region: Region) -> UInt8[Tensor, "first second level"]:
    """Return the classes that a matched house has in a view's region; outside beyond the house."""
    cells = houses[match.house].cells
    corner = (cells.corner[0] + match.shift[0], cells.corner[1] + match.shift[1], region.corner[2])
    found = true_region(cells, Region(corner, region.shape, 0)).classes
    return torch.rot90(found, -match.turns, (0, 1))


def class_frequencies(houses: Sequence[House], region: Region, form: CellForm) -> Int64[Tensor, "first second level c"]:
    """Return how often each cell around a camera was of each class, the camera looking along the first ground axis.

    Args:
        houses: of the training, each from some of its cameras.
        region: a region of the same shape and levels.
        form: classes.
    """
    counts = torch.zeros(*region.shape, len(form.palette), dtype=torch.int64)
    radius = (region.shape[0] // 2) * form.size
    for house in houses:
        for pose in house.poses:
            around = Region.around(house.cells, pose, radius)
            around = Region((*around.corner[:2], region.corner[2]), region.shape, around.quarter)
            classes = around.ahead(true_region(house.cells, around).classes).long()
            counts.scatter_add_(3, classes[..., None], torch.ones_like(classes)[..., None])
    return counts
