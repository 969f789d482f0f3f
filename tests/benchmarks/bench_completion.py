"""How much of the cells that one image does not show can be right at all, and what looking houses up is worth.

``python tests/benchmarks/bench_completion.py --data TEST_HOUSES --train HOUSES [--images N] [--houses N]``, of data
with cells, as ``persist collect`` writes them. Views, measured cells and mIoU are those of ``persist bench scene``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from scipy import ndimage
from torch import Tensor

from persist_cli.api.cell_things import STRUCTURE
from persist_cli.api.cells import FREE, OUTSIDE
from persist_cli.bench.scenes.class_counts import class_counts, things
from persist_cli.bench.scenes.completions import Prior
from persist_cli.bench.scenes.scene_bench import SceneBenchPlan, chosen_files, read_views, training_houses
from persist_cli.bench.scenes.training_houses import House, nearest_houses, vote
from persist_cli.bench.scenes.views import View
from persist_cli.output.console import print_table

Classes = UInt8[Tensor, "first second level"]

SAMPLES = 200  # of a line of sight

VOTES = (1, 3, 5, 10, 20)  # houses


def seen_by_turning(view: View) -> Bool[Tensor, "first second level"]:
    """Return which cells a full turn on the spot would show: only free cells lie between them and the camera."""
    corner, shape = torch.tensor(view.region.corner), torch.tensor(view.region.shape)
    eye, centers = view.frame.cameras.centers[0].double(), view.truth.centers().reshape(-1, 3)
    metres, shown = (centers - eye).norm(dim=-1), torch.ones(len(centers), dtype=torch.bool)
    for share in np.linspace(0, 1, SAMPLES, endpoint=False):
        numbers = view.house.numbers(eye + (centers - eye) * share) - corner
        within = ((numbers >= 0) & (numbers < shape)).all(-1)
        first, second, level = numbers.clamp_min(0).minimum(shape - 1).unbind(-1)
        arrived = metres * (1 - share) < 0.8 * view.truth.form.size  # in the cell itself, or at its side
        shown &= arrived | ~within | (view.truth.classes[first, second, level] == FREE)
    return shown.reshape(view.region.shape)


def without_things(view: View) -> Classes:
    """Return the true cells with free ones in place of all furniture."""
    return torch.where(furniture(view), FREE, view.truth.classes)


def with_seen_things(view: View) -> Classes:
    """Return the same with those pieces of furniture, each whole, of which the image shows a part."""
    classes, there = without_things(view), furniture(view)
    for kind in view.truth.classes[there].unique().tolist():
        labels = torch.from_numpy(ndimage.label(view.truth.classes == kind, structure=np.ones((3, 3, 3)))[0])
        shown = labels[view.known.known & view.known.solid & (labels > 0)].unique()
        classes[torch.isin(labels, shown)] = kind
    return classes


def furniture(view: View) -> Bool[Tensor, "first second level"]:
    """Return which true cells are neither structure nor free nor outside."""
    palette = view.truth.form.palette
    other = torch.tensor([FREE, OUTSIDE, *(palette.index(name) for name in STRUCTURE)])
    return ~torch.isin(view.truth.classes.long(), other)


def knowing(views: Sequence[View], houses: Sequence[House]) -> Iterator[tuple[str, list[Classes]]]:
    """Yield rows that know some of the truth, and guess the rest as ``class prior`` does."""
    row = Prior(houses)
    prior = [row.complete(view, number, 0).classes for number, view in enumerate(views)]
    turned, structure = [seen_by_turning(view) for view in views], [without_things(view) for view in views]
    truth = [view.truth.classes for view in views]
    yield "class prior", prior
    seen = [with_seen_things(view) for view in views]
    whole = [shown | (some != none) for shown, some, none in zip(turned, seen, structure, strict=True)]
    rows = {
        "what a full turn shows": (turned, truth),
        "its structure": (turned, structure),
        "its structure, and whole things of the image": (whole, seen),
    }
    for name, (told, known) in rows.items():
        triples = zip(told, known, prior, strict=True)
        yield f"{name}, else the prior", [torch.where(mask, true, guess) for mask, true, guess in triples]
    yield "all structure, no things", structure
    yield "the same, one cell aside", [torch.roll(known, 1, 0) for known in structure]


def looked_up(views: Sequence[View], houses: Sequence[House]) -> Iterator[tuple[str, list[Classes]]]:
    """Yield what most of the houses that agree best with the known cells have there, each in its best place."""
    matches, classes = nearest_houses(views, houses, max(VOTES)), len(views[0].truth.form.palette)
    for count in VOTES:
        pairs = zip(views, matches, strict=True)
        said = [vote(found[:count], houses, view.region, classes) for view, found in pairs]
        yield f"most of the {count} nearest of {len(houses)} houses", said


def figures(views: Sequence[View], said: Sequence[Classes]) -> list[str]:
    """Return mIoU, that of structure, and IoU by class of structure, of the unseen cells, in percent."""
    palette = views[0].truth.form.palette
    pairs = zip(views, said, strict=True)
    counts = sum(class_counts(classes, view.truth.classes, view.unseen, len(palette)) for view, classes in pairs)
    assert isinstance(counts, np.ndarray)
    both, one, other = counts.T
    present = [n for n in things(len(palette)) if other[n]]
    structure = [n for n in present if palette[n] in STRUCTURE]
    shares = 100 * both / np.maximum(one + other - both, 1)
    means = [f"{shares[classes].mean():.1f}" for classes in (present, structure)]
    return [*means, *(f"{shares[n]:.0f}" for n in structure)]


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="test houses with cells")
    parser.add_argument("--train", type=Path, required=True, help="training houses with cells")
    parser.add_argument("--images", type=int, default=32)
    parser.add_argument("--houses", type=int, default=600, help="most training houses")
    given = parser.parse_args()
    plan = SceneBenchPlan(
        model=None, data=str(given.data), train=given.train, parts=("completion",), images=given.images,
        houses=given.houses,
    )  # fmt: skip
    views = read_views(chosen_files(plan), plan)
    houses = training_houses(plan, views)
    columns = ["unseen cells", "mIoU", "structure", *STRUCTURE]
    for title, rows in (("of the truth", knowing(views, houses)), ("of other houses", looked_up(views, houses))):
        print_table(f"{len(views)} images: what is known {title}", columns, [[n, *figures(views, s)] for n, s in rows])


if __name__ == "__main__":
    main()
