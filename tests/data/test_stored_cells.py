"""The cells of a scene come back as they were at each frame, and damage to them is one line."""

from __future__ import annotations

import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from persist_cli.api.cells import COMMON, CellForm, CellGrid
from persist_cli.api.ground import ground_axes
from persist_cli.data.check.inspect import figures_table, trajectory_figures
from persist_cli.data.store import FRAMES_PER_GROUP, Store, TrajectoryFile, write_trajectory
from persist_cli.data.stored_cells import CellBox
from persist_cli.errors import DataError
from tests.support.noise import INFO, make_frames

FORM = CellForm(0.5, (*COMMON, "wall", "ball"))
CHANGES = 3, FRAMES_PER_GROUP + 1  # frames at which a cell changes, in the first row group and in the second


def grid_at(frame: int) -> CellGrid:
    draws = torch.Generator().manual_seed(0)
    classes = torch.randint(5, (4, 3, 2), generator=draws, dtype=torch.uint8)
    colors = torch.randint(256, (4, 3, 2, 3), generator=draws, dtype=torch.uint8)
    origins = torch.randint(4, (4, 3, 2), generator=draws, dtype=torch.uint8)
    grid = CellGrid(classes, colors, origins, (-2, 5, 0), FORM, ground_axes(INFO.world_up))
    for number, change in enumerate(CHANGES):
        if frame >= change:
            grid.classes[number, 1, 1] = 4
            grid.colors[number, 1, 1] = torch.tensor([9, 8, 7], dtype=torch.uint8)
    return grid


@pytest.fixture
def path(tmp_path: Path) -> Path:
    frames = [replace(frame, cells=grid_at(number)) for number, frame in enumerate(make_frames())]
    write_trajectory(tmp_path / "one.parquet", INFO, frames)
    return tmp_path / "one.parquet"


def test_inspect_counts_the_trajectories_that_have_cells(path: Path) -> None:
    write_trajectory(path.with_name("two.parquet"), INFO, make_frames(2))
    figures = [trajectory_figures(file) for file in Store(path.parent)]
    assert [one.cells for one in figures] == [True, False]
    assert dict(figures_table(figures, {}))["trajectories with the cells of their scene"] == "1"


def rewrite(path: Path, column: list[bytes | None]) -> None:
    """Replace the stored cells of a file."""
    table = pq.read_table(path)
    number = table.schema.get_field_index("cells")
    pq.write_table(table.set_column(number, table.schema.field("cells"), pa.array(column, pa.binary())), path)


@pytest.mark.parametrize("frame", [0, CHANGES[0] - 1, CHANGES[0], CHANGES[1] - 1, CHANGES[1], 19])
def test_the_cells_of_a_frame_come_back_as_they_were(path: Path, frame: int) -> None:
    stored, true = TrajectoryFile(path).cells(frame), grid_at(frame)
    assert (stored.corner, stored.form) == (true.corner, true.form)
    assert all(map(torch.equal, stored.tensors(), true.tensors()))
    assert torch.equal(stored.axes, true.axes)


def test_only_frames_at_which_cells_change_store_some(path: Path) -> None:
    stored = pq.read_table(path, columns=["cells"])["cells"].to_pylist()
    assert [number for number, part in enumerate(stored) if part] == [0, *CHANGES]


def test_frames_are_read_as_from_a_file_without_cells(path: Path, tmp_path: Path) -> None:
    write_trajectory(tmp_path / "bare.parquet", INFO, make_frames())
    bare, stored = TrajectoryFile(tmp_path / "bare.parquet").read(), TrajectoryFile(path).read()
    assert torch.equal(bare.observations.rgb, stored.observations.rgb)
    assert bare.actions == stored.actions


def test_a_file_without_cells_says_so(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "bare.parquet", INFO, make_frames(2))
    assert not TrajectoryFile(tmp_path / "bare.parquet").has_cells
    with pytest.raises(DataError, match=r"bare\.parquet: has no cells of its scene; `persist collect` writes them"):
        TrajectoryFile(tmp_path / "bare.parquet").cells(0)


def test_cells_of_a_frame_that_is_not_there_are_refused(path: Path) -> None:
    with pytest.raises(DataError, match="has 20 frames"):
        TrajectoryFile(path).cells(20)


def test_cells_in_another_box_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    frames = [replace(frame, cells=grid_at(0)) for frame in make_frames(3)]
    frames[2] = replace(frames[2], cells=replace(grid_at(0), corner=(0, 0, 0)))
    with pytest.raises(DataError, match="frame 2: its cells are not in the box of those of frame 0"):
        write_trajectory(tmp_path / "one.parquet", INFO, frames)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("column", "cause"),
    [
        ([None] * 20, "there are none at the first frame"),
        ([b"no cells"] + [None] * 19, "incorrect header check"),
        ([zlib.compress(bytes(99))] + [None] * 19, "99 bytes are not the 120 of the box"),
        ([zlib.compress(bytes(120))[:-1]] + [None] * 19, "cut off"),
    ],
)
def test_damaged_cells_are_one_line(path: Path, column: list[bytes | None], cause: str) -> None:
    rewrite(path, column)
    with pytest.raises(DataError, match=rf"one\.parquet: the cells of frame 5 are damaged \(.*{cause}.*\)$"):
        TrajectoryFile(path).cells(5)


def test_a_damaged_change_is_one_line(path: Path) -> None:
    stored = pq.read_table(path, columns=["cells"])["cells"].to_pylist()
    rewrite(path, [stored[0], stored[0], *[None] * 18])
    with pytest.raises(DataError, match="the cells of frame 1 are damaged"):
        TrajectoryFile(path).cells(1)


def test_cells_that_would_fill_the_machine_are_refused_before_they_do(path: Path) -> None:
    stored = pq.read_table(path, columns=["cells"])["cells"].to_pylist()
    bomb = zlib.compress(bytes(2**28))
    for column, bytes_of_a_cell in (([bomb, *[None] * 19], 5), ([stored[0], bomb, *[None] * 18], 9)):
        rewrite(path, column)
        tracemalloc.start()
        with pytest.raises(DataError, match=f"more than the {24 * bytes_of_a_cell} bytes of the box"):
            TrajectoryFile(path).cells(1)
        assert tracemalloc.get_traced_memory()[1] < 2**26
        tracemalloc.stop()


def test_a_box_of_more_cells_than_can_be_stored_is_refused(tmp_path: Path) -> None:
    form = FORM.to_json() | {"corner": [0, 0, 0]}
    with pytest.raises(ValueError, match="has more than 134,217,728 cells"):
        CellBox.from_json(form | {"shape": [2**32, 2**32, 1]})
    large = torch.zeros(1, dtype=torch.uint8).expand(2**10, 2**10, 2**8)
    grid = CellGrid(large, large[..., None].expand(*large.shape, 3), large, (0, 0, 0), FORM, grid_at(0).axes)
    with pytest.raises(DataError, match="frame 0: its box has 268,435,456 cells, more than"):
        write_trajectory(tmp_path / "one.parquet", INFO, [replace(make_frames(1)[0], cells=grid)])


def test_a_lost_column_is_named(path: Path) -> None:
    pq.write_table(pq.read_table(path).drop_columns(["cells"]), path)
    with pytest.raises(DataError, match=r"one\.parquet: its column cells is missing"):
        TrajectoryFile(path).cells(0)


def test_inspect_says_that_there_are_cells(path: Path, persist) -> None:
    assert "trajectories with the cells of their scene" in persist("inspect", path.parent).out
