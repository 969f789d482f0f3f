"""Ground that is free in an open scene: a grid of places with the ways between them, and straight ways."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator

from persist_cli.api.simulator import Simulator

SPACING = 0.2  # metres between places of the grid
FINE = 0.1  # metres between the places that are checked along a straight way
NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]

Ground = tuple[float, float]
Cell = tuple[int, int]


class FreeGrid:
    """The free places of the open scene on a square grid.

    Args:
        simulator: has an open scene, of which the places that are free now count.
    """

    def __init__(self, simulator: Simulator) -> None:
        low, high = simulator.bounds
        self._low = low
        counts = [max(1, math.ceil((b - a) / SPACING)) for a, b in zip(low, high, strict=True)]
        cells = ((i, j) for i in range(counts[0]) for j in range(counts[1]))
        self.free = {cell for cell in cells if simulator.is_free(self.place(cell))}
        self._beside = {cell: list(self._neighbours(cell)) for cell in self.free}

    def place(self, cell: Cell) -> Ground:
        """The middle of a cell in metres."""
        return self._low[0] + (cell[0] + 0.5) * SPACING, self._low[1] + (cell[1] + 0.5) * SPACING

    def cell(self, ground: Ground) -> Cell:
        """The cell around a place."""
        x, z = ((value - low) / SPACING for value, low in zip(ground, self._low, strict=True))
        return math.floor(x), math.floor(z)

    def distances(self, goal: Ground) -> dict[Cell, float]:
        """Metres of the shortest way from each cell to the goal (Dijkstra); cells without a way are missing."""
        distances: dict[Cell, float] = {}
        queue = [(offset, cell) for cell, offset in self.around(goal)]
        heapq.heapify(queue)
        while queue:
            distance, cell = heapq.heappop(queue)
            if cell in distances:
                continue
            distances[cell] = distance
            for neighbour, length in self._beside[cell]:
                if neighbour not in distances:
                    heapq.heappush(queue, (distance + length, neighbour))
        return distances

    def around(self, ground: Ground) -> list[tuple[Cell, float]]:
        """The free cells at and beside a place, nearest first, with the metres to their middles.

        A free place may lie in a cell whose middle is not free.
        """
        i, j = self.cell(ground)
        cells = [(i + by_i, j + by_j) for by_i, by_j in [(0, 0), *NEIGHBOURS]]
        near = [(cell, math.dist(ground, self.place(cell))) for cell in cells if cell in self.free]
        return sorted(near, key=lambda item: item[1])

    def remaining(self, ground: Ground, distances: dict[Cell, float]) -> float:
        """Metres from a place to the goal of ``distances``, infinite without a way."""
        return min((distances.get(cell, math.inf) + offset for cell, offset in self.around(ground)), default=math.inf)

    def metres(self, ground: Ground, distances: dict[Cell, float]) -> float:
        """Metres from a place to the goal of ``distances``, infinite only where there are none.

        A free place may be so narrow that no free cell lies beside it: then by the nearest way of all.
        """
        metres = self.remaining(ground, distances)
        if math.isfinite(metres):
            return metres
        return min((way + math.dist(ground, self.place(cell)) for cell, way in distances.items()), default=math.inf)

    def _neighbours(self, cell: Cell) -> Iterator[tuple[Cell, float]]:
        """Free cells beside a cell, and diagonal ones when no corner stands in between."""
        i, j = cell
        for by_i, by_j in NEIGHBOURS:
            beside = (i + by_i, j) in self.free and (i, j + by_j) in self.free
            if (i + by_i, j + by_j) in self.free and beside:
                yield (i + by_i, j + by_j), SPACING * math.hypot(by_i, by_j)


class Geodesic:
    """Metres of the shortest way to a goal in the open scene.

    The straight line counts where it is free, else ways over a grid of places 0.2 m apart with their diagonals, which
    are up to 8 % longer than the shortest ones.

    Args:
        simulator: has an open scene, in which only the agent moves.
        goal: on the ground, metres.
        grid: of the scene, where it is there already.
    """

    def __init__(self, simulator: Simulator, goal: Ground, grid: FreeGrid | None = None) -> None:
        self._simulator, self._goal = simulator, goal
        self._grid = FreeGrid(simulator) if grid is None else grid
        self._distances = self._grid.distances(goal)

    def metres(self, ground: Ground) -> float:
        """Return the metres from a place; where no way of the grid leads away from it, by the nearest way of all."""
        straight = math.dist(ground, self._goal)
        parts = max(1, math.ceil(straight / FINE))
        (x, z), (to_x, to_z) = ground, self._goal
        ways = [(x + n / parts * (to_x - x), z + n / parts * (to_z - z)) for n in range(parts + 1)]
        return straight if all(map(self._simulator.is_free, ways)) else self.along_grid(ground)

    def along_grid(self, ground: Ground) -> float:
        """Return the metres of a way over the grid alone, whether the straight line is free or not."""
        return self._grid.metres(ground, self._distances)

    def places(self) -> list[Ground]:
        """Return the places of the grid from which a way leads to the goal."""
        return [self._grid.place(cell) for cell in sorted(self._distances)]


def clear_distance(simulator: Simulator, start: Ground, heading: float, longest: float, stride: float) -> float:
    """Metres that the agent could walk straight ahead from a place, in whole strides."""
    x, z = simulator.ahead(heading)
    parts = max(1, math.ceil(stride / FINE))
    for number in range(1, parts * math.floor(longest / stride + 1e-9) + 1):
        walked = number * stride / parts
        if not simulator.is_free((start[0] + walked * x, start[1] + walked * z)):
            return (number - 1) // parts * stride
    return math.floor(longest / stride + 1e-9) * stride
