import torch

from persist_memory.grid.storage import AXIS_BITS, BLOCK, LIMIT, SparseGrid, ValueColumn, keys_of_numbers, pack, unpack


def random_cells(count: int, reach: int = 40, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(-reach, reach, (count, 3), generator=generator)


def make_grid() -> SparseGrid:
    return SparseGrid(
        {"best": ValueColumn(2, torch.float32, torch.maximum), "count": ValueColumn(0, torch.int64, torch.add)}
    )


def absorb(grid: SparseGrid, cells: torch.Tensor, best: torch.Tensor) -> None:
    keys, order = pack(*cells.unbind(-1)).sort()
    grid.absorb(keys, {"best": best[order], "count": torch.ones_like(keys)})


def test_unpacking_a_key_gives_the_cell_back_up_to_the_limits():
    cells = torch.cat([random_cells(500, LIMIT), torch.tensor([[-LIMIT, LIMIT - 1, 0], [0, -1, -LIMIT]])])
    keys = pack(*cells.unbind(-1))
    assert torch.equal(unpack(keys), cells)
    assert (keys >= 0).all()


def test_the_number_of_a_cell_and_its_coordinates_give_one_key():
    cells = torch.cat([random_cells(500, LIMIT - 1), torch.tensor([[1 - LIMIT, LIMIT - 1, 0], [0, -1, 1 - LIMIT]])])
    x, y, z = cells.unbind(-1)
    numbers = x + (y << AXIS_BITS) + (z << (2 * AXIS_BITS))
    assert torch.equal(keys_of_numbers(numbers), pack(x, y, z))


def test_different_cells_have_different_keys():
    cells = random_cells(5000).unique(dim=0)
    assert len(pack(*cells.unbind(-1)).unique()) == len(cells)


def test_the_cells_of_a_block_are_neighbours_in_the_order_of_keys():
    cells = unpack(pack(*random_cells(5000).unbind(-1)).sort().values)
    blocks = torch.unique_consecutive(torch.div(cells, BLOCK, rounding_mode="floor"), dim=0)
    assert len(blocks) == len(blocks.unique(dim=0))


def test_a_grid_holds_the_same_whatever_the_order_of_writing():
    cells = [random_cells(200, 6, seed).unique(dim=0) for seed in range(5)]
    values = [torch.randn(len(part), 2) for part in cells]
    forward, backward = make_grid(), make_grid()
    for number in range(5):
        absorb(forward, cells[number], values[number])
        absorb(backward, cells[4 - number], values[4 - number])
    assert torch.equal(forward.keys, backward.keys)
    assert torch.equal(forward.values("best"), backward.values("best"))
    assert torch.equal(forward.values("count"), backward.values("count"))


def test_a_cell_holds_the_greatest_value_and_the_count_of_its_writes():
    grid, cell = make_grid(), torch.tensor([[1, -2, 3]])
    for value in ([1.0, 5.0], [4.0, 2.0]):
        absorb(grid, cell, torch.tensor([value]))
    assert grid.values("best").tolist() == [[4.0, 5.0]]
    assert grid.values("count").tolist() == [2]


def test_every_cell_lies_in_exactly_one_block():
    grid = make_grid()
    cells = random_cells(3000).unique(dim=0)
    absorb(grid, cells, torch.zeros(len(cells), 2))
    blocks, starts, counts = grid.blocks()
    assert int(counts.sum()) == len(cells)
    owner = torch.arange(len(blocks)).repeat_interleave(counts)
    assert torch.equal(torch.div(unpack(grid.keys), BLOCK, rounding_mode="floor"), blocks[owner])
    assert torch.equal(starts, counts.cumsum(0) - counts)
