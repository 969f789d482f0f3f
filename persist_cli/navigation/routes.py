"""Shortest ways over a map of the ground, by Dijkstra's search on its squares and their eight neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from persist_cli.api.ground import Cover, GroundMap
from persist_cli.errors import DataError

SNAP = 0.5  # metres from a place within which the nearest walkable square stands for it
FARTHEST = 50.0  # metres from all that is known to a place; a search over so much unknown ground takes all memory
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # row and column of half of a square's neighbours


@dataclass(frozen=True)
class Distances:
    """How far each square of a map is from some places, along the ground.

    Args:
        ground: the map, as large as the distances.
        metres: of the shortest way from each square; infinite where there is none.
    """

    ground: GroundMap
    metres: Float[Tensor, "row column"]

    def at(self, places: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return the metres of the shortest way from places on the ground axes, infinite without one, float64.

        A place without a way, such as one that is too near to a wall, takes that of the square with the shortest way
        within 0.5 m of it on its own side of all that is occupied, and the straight metres to that.
        """
        flat = places.reshape(-1, 2).double()
        metres = self._from_squares(flat[:, None])[:, 0]
        lost = metres.isinf()
        if bool(lost.any()):
            metres[lost] = self._from_beside(flat[lost])
        return metres.reshape(places.shape[:-1])

    def _from_beside(self, places: Float[Tensor, "place 2"]) -> Float[Tensor, " place"]:
        """The metres of the shortest way from squares beside places, with the straight way to them."""
        count = math.ceil(SNAP / self.ground.spacing)
        steps = torch.arange(-count, count + 1, dtype=torch.float64) * self.ground.spacing
        offsets = torch.cartesian_prod(steps, steps)
        offsets = offsets[offsets.norm(dim=1) <= SNAP]
        metres = self._from_squares(places[:, None] + offsets) + offsets.norm(dim=1)
        left = torch.arange(len(places))
        while len(left):  # the straight way to the best square of most places is clear
            least, number = metres[left].min(1)
            left, number = left[least.isfinite()], number[least.isfinite()]
            blocked = self._leads_into_something(places[left], offsets[number])
            metres[left[blocked], number[blocked]] = math.inf
            left = left[blocked]
        nearest: Float[Tensor, " place"] = metres.amin(1)
        return nearest

    def _leads_into_something(
        self, places: Float[Tensor, "place 2"], offsets: Float[Tensor, "place 2"]
    ) -> Bool[Tensor, " place"]:
        """Whether the straight way by an offset comes into what is occupied; out of it, it may lead."""
        count = math.ceil(2 * SNAP / self.ground.spacing)
        shares = torch.linspace(0, 1, count + 1, dtype=torch.float64)[:, None, None]
        occupied = self.ground.at(places + shares * offsets) == Cover.OCCUPIED
        entered: Bool[Tensor, " place"] = (occupied[1:] & ~occupied[:-1]).any(0)
        return entered

    def _from_squares(self, places: Float[Tensor, "place near 2"]) -> Float[Tensor, "place near"]:
        """The metres of the squares that places lie in; infinite outside of the map."""
        rows, columns = self.metres.shape
        squares = ((places - places.new_tensor(self.ground.origin)) / self.ground.spacing).floor().long()
        column, row = squares.unbind(-1)
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        metres = torch.full(inside.shape, math.inf, dtype=torch.float64)
        metres[inside] = self.metres[row[inside], column[inside]]
        return metres


def check_within_reach(
    name: str, position: Float[Tensor, " 3"], ground: GroundMap, known: Sequence[Float[Tensor, "_ 3"]]
) -> None:
    """Raise ``DataError`` when a place is farther than ``FARTHEST`` metres on the ground from all that is known.

    Args:
        name: of the place, in the error.
        position: of the place, world metres.
        ground: what is known to be free or occupied.
        known: further positions that are known, world metres; the first is where an agent stands.
    """
    places = [ground.places(positions.cpu()) for positions in known]
    metres = float((torch.cat([*places, ground.known_places()]) - ground.places(position.cpu())).norm(dim=1).min())
    if not metres <= FARTHEST:  # a place may be no number
        x, y = places[0][0].tolist()
        raise DataError(
            f"{name}: {metres:.0f} m from all that is known, which is too far to plan a way; name a place within "
            f"{FARTHEST:g} m of it (the start is at {x:.1f},{y:.1f})"
        )


def walkable(ground: GroundMap, radius: float, unknown: bool = False) -> Bool[Tensor, "row column"]:
    """Return the squares on which the middle of a disc may be: free, and no occupied square's middle under the disc.

    Args:
        ground: the map.
        radius: of the disc, metres.
        unknown: whether unknown ground counts as free.
    """
    if not ground.states.numel():
        return torch.zeros(ground.states.shape, dtype=torch.bool)
    occupied = ground.states == Cover.OCCUPIED
    chosen = ~occupied if unknown else ground.states == Cover.FREE
    if not bool(occupied.any()):
        return chosen
    return chosen & (squares_apart(occupied) * ground.spacing >= radius)


def squares_apart(squares: Bool[Tensor, "row column"]) -> Float[Tensor, "row column"]:
    """Return for each square how many sides its middle is away from the nearest of the given squares."""
    from scipy import ndimage

    return torch.from_numpy(ndimage.distance_transform_edt(~squares.numpy()))


def distances_to(
    ground: GroundMap,
    places: Float[Tensor, "place 2"],
    radius: float,
    unknown: float | None = None,
    costs: Float[Tensor, "row column"] | None = None,
) -> Distances:
    """Return the metres of the shortest way of a disc from every square to the nearest of some places.

    A place on which the disc cannot stand is reached from the nearest walkable squares within 0.5 m, by a straight way.

    Args:
        ground: the map. With ``unknown`` it is enlarged so that it holds the places.
        places: on the ground axes, metres.
        radius: of the disc, metres.
        unknown: how many metres a metre over unknown ground counts; ``None`` when no way leads over it.
        costs: further factor of the metres on each square, at least 1; metres are then no longer true ones.
    """
    if unknown is not None:
        ground = holding(ground, places)
    allowed = walkable(ground, radius, unknown is not None)
    factors = torch.ones(allowed.shape, dtype=torch.float64) if costs is None else costs.double().clone()
    if unknown is not None:
        factors[ground.states == Cover.UNKNOWN] *= unknown
    metres = _dijkstra(allowed.numpy(), factors.numpy() * ground.spacing, _sources(ground, allowed, places))
    return Distances(ground, torch.from_numpy(metres))


def holding(ground: GroundMap, places: Float[Tensor, "place 2"], margin: float = 1.0) -> GroundMap:
    """Return the map with unknown squares added, so that it holds the places with ``margin`` metres around them."""
    rows, columns = ground.states.shape
    origin, spacing = torch.tensor(ground.origin, dtype=torch.float64), ground.spacing
    if not ground.states.numel():
        origin = places.double().amin(0)
        ground = replace(ground, origin=(float(origin[0]), float(origin[1])))
    low = ((places.double().amin(0) - margin - origin) / spacing).floor().long().clamp_max(0)
    high = ((places.double().amax(0) + margin - origin) / spacing).ceil().long() - torch.tensor([columns, rows])
    left, bottom, right, top = *(-low).tolist(), *high.clamp_min(0).tolist()
    states = functional.pad(ground.states, (left, right, bottom, top), value=int(Cover.UNKNOWN))
    x, y = (origin + low * spacing).tolist()
    return replace(ground, states=states, origin=(x, y))


def _sources(
    ground: GroundMap, allowed: Bool[Tensor, "row column"], places: Float[Tensor, "place 2"]
) -> list[tuple[int, float]]:
    """The flat numbers of the squares from which a search begins, each with its metres to the place beside it."""
    squares = allowed.nonzero()
    if not len(squares):
        return []
    middles = (squares.flip(1) + 0.5) * ground.spacing + torch.tensor(ground.origin, dtype=torch.float64)
    found: dict[int, float] = {}  # a square beside several places begins with the nearest of them
    for place in places.double():
        apart = (middles - place).norm(dim=1)
        near = (apart <= max(float(apart.min()) + ground.spacing / 2, ground.spacing)) & (apart <= SNAP)
        for row, column, metres in zip(*squares[near].T.tolist(), apart[near].tolist(), strict=True):
            number = row * allowed.shape[1] + column
            found[number] = min(metres, found.get(number, math.inf))
    return [*found.items()]


def _dijkstra(
    allowed: NDArray[np.bool_], costs: NDArray[np.float64], sources: Sequence[tuple[int, float]]
) -> NDArray[np.float64]:
    """The least cost of each square from the sources; a diagonal step needs the two squares beside it."""
    from scipy.sparse import csgraph, csr_matrix

    if not sources:
        return np.full(allowed.shape, np.inf)
    rows, columns = allowed.shape
    numbers = np.arange(rows * columns).reshape(rows, columns)
    starts, ends, lengths = [], [], []
    for by_row, by_column in NEIGHBOURS:
        here, there, beside, below = _shifted(by_row, by_column)
        edges = allowed[here] & allowed[there]
        if by_row and by_column:
            edges &= allowed[beside] & allowed[below]
        starts.append(numbers[here][edges])
        ends.append(numbers[there][edges])
        lengths.append((costs[here] + costs[there])[edges] / 2 * math.hypot(by_row, by_column))
    count = rows * columns + 1  # the last node is joined to all sources
    begun, offsets = zip(*sources, strict=True)
    starts.append(np.full(len(sources), count - 1))
    ends.append(np.array(begun))
    lengths.append(np.maximum(offsets, 1e-9))  # scipy takes a length of zero for no edge
    values = np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))
    graph = csr_matrix(values, shape=(count, count))
    metres: NDArray[np.float64] = csgraph.dijkstra(graph, directed=False, indices=count - 1)
    return metres[:-1].reshape(rows, columns)


def _shifted(by_row: int, by_column: int) -> tuple[tuple[slice, slice], ...]:
    """Slices of squares, of their neighbours in a direction, and of the two squares beside a diagonal step."""
    upper, lower = (slice(None, -1), slice(1, None)) if by_row else (slice(None), slice(None))
    if by_column == 0:
        left, right = slice(None), slice(None)
    else:
        left, right = slice(None, -1), slice(1, None)
    if by_column < 0:
        left, right = right, left
    return (upper, left), (lower, right), (upper, right), (lower, left)
