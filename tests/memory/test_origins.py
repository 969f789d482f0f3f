"""What a model imagined never changes what was observed, and an observation replaces it."""

from dataclasses import replace

import pytest
import torch

from persist_cli.api.observations import Observations, Origin
from persist_cli.errors import CheckpointError, DataError
from tests.support.room_views import empty_memory, observe, room_walk, same_bits, written_memory
from tests.support.rooms import look

KINDS = [
    ("voxel", {}),
    ("voxel", {"pooling": "mean"}),
    ("map2d", {}),
    ("map2d", {"pooling": "mean"}),
    ("snapshots", {}),
]
of_every_kind = pytest.mark.parametrize(("name", "settings"), KINDS)


def imagined(observations: Observations) -> Observations:
    """Bright frames at the same poses, whose depth is wrong by a few centimetres."""
    noise = torch.randn(observations.depth.shape, generator=torch.Generator().manual_seed(0))
    depth = observations.depth + 0.05 * noise * (observations.depth > 0)
    return replace(observations, rgb=255 - observations.rgb // 4, depth=depth).with_origin(Origin.IMAGINED)


def stored_as(memory, origin: Origin) -> dict[str, torch.Tensor]:
    """The tensors of the items of one origin."""
    tensors = memory.tensors()
    return {name: tensor[tensors["origins"] == origin] for name, tensor in tensors.items()} if tensors else {}


def equal(first, second) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_frames_are_observed_until_they_are_said_to_be_imagined_and_keep_it_in_every_part():
    seen, dreamt = room_walk(3), imagined(room_walk(2))
    assert seen.origins.tolist() == [Origin.OBSERVED] * 3
    joined = Observations.concatenate([seen, dreamt]).to("cpu")
    assert joined[[4, 0]].origins.tolist() == [Origin.IMAGINED, Origin.OBSERVED]
    assert [(origin, len(part)) for origin, part in joined.by_origin()] == [(Origin.OBSERVED, 3), (Origin.IMAGINED, 2)]


@of_every_kind
def test_imagined_frames_change_no_bit_of_what_was_observed(name, settings):
    walk = room_walk()
    memory = written_memory(name, walk[:5], **settings)
    before = memory.tensors()
    memory.write(imagined(walk))
    assert equal(stored_as(memory, Origin.OBSERVED), before)
    assert len(stored_as(memory, Origin.IMAGINED)["origins"]) > 0


@of_every_kind
def test_an_observation_replaces_what_was_imagined_of_the_same_place(name, settings):
    walk = room_walk(3)
    memory = written_memory(name, replace(imagined(walk), depth=walk.depth), **settings)
    assert memory.figures().imagined == memory.figures().cells > 0
    memory.write(walk)
    assert same_bits(memory, written_memory(name, walk, **settings))


@of_every_kind
def test_observed_and_imagined_frames_may_come_in_one_write(name, settings):
    walk = room_walk()
    frames = [imagined(walk[4:]), walk[:4]]
    one, two = empty_memory(name, **settings), empty_memory(name, **settings)
    one.write(Observations.concatenate(frames))
    two.write(frames[1])
    two.write(frames[0])
    assert same_bits(one, two)


@of_every_kind
def test_a_merge_keeps_what_was_observed_on_either_side(name, settings):
    walk = room_walk()
    seen, dreamt = written_memory(name, walk[:5], **settings), written_memory(name, imagined(walk), **settings)
    before = seen.tensors()
    for first, second in ((seen.copy(), dreamt), (dreamt.copy(), seen)):
        first.merge(second)
        assert equal(stored_as(first, Origin.OBSERVED), before)
        assert first.figures().imagined > 0


@of_every_kind
def test_a_memory_counts_imagined_items_and_knows_its_imagined_points(name, settings):
    memory = written_memory(name, room_walk(2), **settings)
    observed = memory.figures().cells
    assert memory.figures().imagined == 0
    memory.write(imagined(room_walk()))
    figures = memory.figures()
    assert (figures.observed, figures.imagined) == (observed, figures.cells - observed)
    assert set(memory.points().origins.tolist()) == {Origin.IMAGINED, Origin.OBSERVED}
    assert memory.header()["imagined"] == figures.imagined


@of_every_kind
def test_tensors_without_origins_are_observed_as_in_files_of_version_1(name, settings):
    memory, restored = written_memory(name, room_walk(3), **settings), empty_memory(name, **settings)
    restored.restore({key: tensor for key, tensor in memory.tensors().items() if key != "origins"})
    assert same_bits(memory, restored)


@of_every_kind
def test_an_unknown_origin_is_refused_and_nothing_changes(name, settings):
    memory, before = (written_memory(name, room_walk(2), **settings) for _ in range(2))
    tensors = memory.tensors()
    tensors["origins"] = tensors["origins"] + 7
    with pytest.raises(CheckpointError, match="unknown origin 9"):
        memory.restore(tensors)
    assert same_bits(memory, before)


def test_frames_with_too_few_origins_are_refused():
    frames = room_walk(2)
    with pytest.raises(DataError, match="origins differ"):
        empty_memory("voxel").write(replace(frames, origins=frames.origins[:1]))


def test_imagined_images_take_no_room_from_observed_ones():
    turn = observe([look((0.0, 1.4, 0.0), yaw) for yaw in range(0, 360, 45)])
    memory = written_memory("snapshots", turn[:4], capacity=4)
    memory.write(imagined(turn[4:]))
    assert (memory.figures().observed, memory.figures().imagined) == (4, 4)
    memory.write(imagined(observe([look((0.3, 1.4, 0.0), yaw) for yaw in range(200, 320, 10)])))
    assert (memory.figures().observed, memory.figures().imagined) == (4, 4)


def test_of_an_imagined_image_only_patches_that_no_observed_image_shows_are_recalled():
    views = observe([look((0.0, 1.4, 0.0), yaw) for yaw in (0.0, 30.0)])
    memory = written_memory("snapshots", views[:1])
    memory.write(views[1:].with_origin(Origin.IMAGINED))
    shown = stored_as(memory, Origin.IMAGINED)["depth"] > 0
    assert 8 <= int(shown.sum()) <= 48


@of_every_kind
def test_tokens_say_what_was_imagined_and_have_the_colours_of_the_points_that_people_see(name, settings):
    walk = room_walk(6)
    memory = written_memory(name, walk[:2], **settings)
    memory.write(imagined(walk))
    tokens, points = memory.read(walk.cameras, 100_000), memory.points()
    read = rows_of(tokens.positions if name != "map2d" else tokens.colors, tokens.colors, tokens.origins)
    assert {row[-1] for row in read} == {Origin.OBSERVED, Origin.IMAGINED}
    assert read <= rows_of(points.positions if name != "map2d" else points.colors, points.colors, points.origins)


def rows_of(positions, colors, origins) -> set[tuple[float, ...]]:
    columns = (positions.double(), colors.double(), origins[:, None].double())
    return {tuple(row) for row in torch.cat(columns, dim=-1).tolist()}


GRIDS = pytest.mark.parametrize("name", ["voxel", "map2d"])


@GRIDS
@pytest.mark.parametrize("pooling", ["max", "mean"])
def test_written_once_the_first_imagined_view_of_a_place_stays(name, pooling):
    walk = room_walk(3)
    memory = written_memory(name, imagined(walk), pooling=pooling, imagined="once")
    before = memory.tensors()
    again = replace(imagined(walk), rgb=walk.rgb // 2)
    memory.write(again)
    kept = dict(zip(map(tuple, memory.tensors()["cells"].tolist()), memory.tensors()["colors"], strict=True))
    assert all(
        kept[tuple(cell)] == color for cell, color in zip(before["cells"].tolist(), before["colors"], strict=True)
    )
    merged = written_memory(name, imagined(walk), pooling=pooling)
    merged.write(again)
    assert len(memory.tensors()["cells"]) <= len(merged.tensors()["cells"])


def test_written_once_an_observation_still_replaces_what_was_imagined():
    walk = room_walk(2)
    memory = written_memory("voxel", imagined(walk), imagined="once")
    memory.write(walk)
    observed = written_memory("voxel", walk, imagined="once")
    assert equal(stored_as(memory, Origin.OBSERVED), observed.tensors())


@GRIDS
def test_maps_that_write_what_is_imagined_by_other_rules_can_be_merged(name):
    walk = room_walk(4)
    memory = written_memory(name, walk[:2], imagined="once", closing=0.3)
    memory.merge(written_memory(name, walk[2:], edges=0.2, least_new=0.1))
    assert same_bits(memory, written_memory(name, walk))


@GRIDS
def test_a_map_that_never_writes_what_is_imagined_holds_what_was_observed_alone(name):
    walk = room_walk(4)
    memory = written_memory(name, imagined(walk[:2]), imagined="never")
    assert memory.tensors() == {}
    memory.write(Observations.concatenate([walk[:2], imagined(walk[2:])]))
    assert same_bits(memory, written_memory(name, walk[:2], imagined="never"))


def test_an_imagined_frame_that_adds_too_little_is_not_written():
    ahead, beside = (observe([look((0.0, 1.4, 0.0), yaw)]) for yaw in (0.0, 15.0))
    sizes = {}
    for least in (0.0, 0.6):
        memory = written_memory("voxel", ahead, cell=(0.1, 0.1, 0.1), least_new=least)
        before = len(memory.tensors()["cells"])
        memory.write(imagined(beside))
        sizes[least] = len(memory.tensors()["cells"]) - before
    assert sizes[0.0] > 0
    assert sizes[0.6] == 0


def test_imagined_pixels_on_depth_edges_are_not_written():
    view = observe([look((0.0, 1.4, 0.0), 0.0)]).with_origin(Origin.IMAGINED)
    view.depth[:, :, 40:] *= 0.5
    whole, cut = (written_memory("voxel", view, cell=(0.05,) * 3, edges=edges).figures().cells for edges in (0.0, 0.2))
    none = written_memory("voxel", view, cell=(0.05,) * 3, edges=1e-9).figures().cells
    assert none < cut < whole


def test_gaps_between_known_cells_are_not_imagined_again():
    view = observe([look((0.0, 1.4, 0.0), 0.0)])
    sparse = replace(view, depth=view.depth.clone())
    sparse.depth[:, ::2, ::2] = 0.0
    added = {}
    for share in (1.0, 0.3):
        memory = written_memory("voxel", sparse, cell=(0.02,) * 3, imagined="once", closing=share)
        memory.write(imagined(view))
        added[share] = memory.figures().imagined
    assert added[1.0] > 100
    assert added[0.3] == 0
