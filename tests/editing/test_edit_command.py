"""``persist edit`` changes scenes and voxel maps, and shows them before and after."""

import json
import math

import pytest
import torch
from PIL import Image

from persist_cli.api.cells import FREE, CellOrigin
from persist_cli.api.memory import FrameOfReference
from persist_cli.editing.edit import summary
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.plugins import make_encoder, make_memory
from tests.support.cell_rooms import TABLE_CELLS, UP, camera_at, cell_room


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The file of a scene with a table and a box, and a path from which both are seen."""
    grid = cell_room()
    memory = make_memory(
        "scene", {"palette": list(grid.form.palette)}, make_encoder("classes", {}), FrameOfReference("room", UP)
    )
    memory.add(grid)
    poses = torch.cat([camera_at(grid, (11, 11, 6), toward).world_from_camera for toward in ((12, 12, 6), (4, 6, 1))])
    file = tmp_path_factory.mktemp("scene") / "room.safetensors"
    memory.save(file, {"walk": poses})
    return file


def test_things_are_listed_with_the_names_that_edits_take(persist, room):
    things = json.loads(persist("edit", room, "--list", "--json").out)
    assert [thing["name"] for thing in things] == ["table#1", "box#1"]
    assert things[1]["color"] == "#c81414"
    assert "table#1" in persist("edit", room, "--list").out


def test_edits_are_done_in_the_order_of_the_command_line_and_shown(persist, room, tmp_path):
    out = tmp_path / "edited.safetensors"
    result = persist(
        "edit", room, "--paint", "table#1", "#0000ff", "--move", "table#1", "1,0,-0.5", "--remove", "box#1",
        "--out", out, "--save-edits", tmp_path / "edits.json", "--json",
    )  # fmt: skip
    assert result.code == 0, result.err
    report = json.loads(result.out)
    assert [edit["edit"] for edit in report["edits"]] == ["paint", "move", "remove"]
    cells = load_memory(out).cells
    assert cells.colors[8, 9, 2].tolist() == [0, 0, 255]
    assert bool((cells.classes[TABLE_CELLS] == FREE).all())
    assert int(cells.origins[8, 9, 2]) == CellOrigin.EDITED
    assert report["pictures"]["cells"]["inside"] > 10
    assert report["pictures"]["cells"]["outside"] == 0
    assert report["view"] == "frame 1 of path 'walk'"
    names = {"edited.safetensors", "edited.json", "edited.png", "edited-views.png", "edits.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert Image.open(tmp_path / "edited-views.png").width > 500
    assert torch.equal(load_paths(out)["walk"], load_paths(room)["walk"])


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0, "no pixel looks at the edit; --camera DATA#trajectory:frame names another view"),
        (0.5, "pixels that look at the edit change by 20 of 255 on average, others by 1"),
        (1, "pixels that look at the edit change by 20 of 255 on average"),
    ],
)
def test_the_summary_says_what_changes_where_pixels_look_at_the_edit(share, words):
    change = {"inside": 20.0 if share else math.nan, "outside": math.nan if share == 1 else 1.0, "share": share}
    report = {"uncovered": 0, "edits": [{}], "changed": 9, "scene": "room", "view": "house#0:2"}
    text = summary(report | {"pictures": {"cells": change}}, {"views": "views.png"}, camera_named=True)
    assert f"cells from house#0:2: {words}" in text.splitlines()


def test_a_file_of_edits_gives_the_same_memory_to_the_bit(persist, room, tmp_path):
    one, two = tmp_path / "one.safetensors", tmp_path / "two.safetensors"
    options = ("--remove", "0.375,0,0.375:0.875,1,1.125", "--insert", "box", "2,_,1")
    persist("edit", room, *options, "--out", one, "--save-edits", tmp_path / "edits.json")
    persist("edit", room, "--edits", tmp_path / "edits.json", "--out", two)
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--remove", "9,9,9:10,10,10"], "edit 1 (remove): the box 9,9,9:10,10,10 lies outside of the scene"),
        (["--remove", "chair#1"], "'chair#1' is no box x,y,z:x,y,z in metres, nor a thing: there are: table#1, box#1"),
        (
            ["--remove", "box#1", "--insert", "tabel", "1,_,1"],
            "edit 2 (insert): the scene has no class 'tabel'; did you",
        ),
        (["--move", "table#1", "30,0,0"], "edit 1 (move): it would reach out of the scene"),
        (["--copy", "table#1", "0.25,0,0"], "let it replace them (--overwrite)"),
        (["--edits", "{large}"], "a thing of 1e+09,1e+09,1e+09 m is larger than the scene"),
        ([], "nothing to edit; for example --remove table#1"),
    ],
)
def test_an_edit_that_cannot_be_done_is_one_line_and_writes_nothing(persist, room, tmp_path, options, words):
    large = tmp_path.with_suffix(".json")
    large.write_text(json.dumps([{"edit": "insert", "kind": "table", "at": [0, 1, 0], "size": [1e9, 1e9, 1e9]}]))
    options = [option.format(large=large) for option in options]
    result = persist("edit", room, *options, "--out", tmp_path / "edited.safetensors")
    assert result.code == 1
    assert words in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--edits", "--save-edits"])
def test_the_report_of_an_edit_replaces_no_file_of_edits(persist, room, tmp_path, option):
    mine = tmp_path / "mine.json"
    if option == "--edits":
        mine.write_text('[{"edit": "remove", "low": [0.4, 0, 0.4], "high": [0.8, 1, 1.1]}]')
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    given = ["--remove", "box#1", option, mine]
    result = persist("edit", room, *given, "--out", tmp_path / "mine.safetensors")
    assert (result.code, len(result.err.strip().splitlines())) == (1, 1)
    assert f"mine.json: it is {option}, and the report of --out" in result.err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_edits_are_not_saved_in_the_place_of_the_memory(persist, room, tmp_path):
    mine = tmp_path / "mine.safetensors"
    mine.write_bytes(room.read_bytes())
    result = persist("edit", mine, "--remove", "box#1", "--out", tmp_path / "a.safetensors", "--save-edits", mine)
    assert (result.code, "--save-edits would replace it" in result.err) == (1, True)
    assert mine.read_bytes() == room.read_bytes()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--list", "--remove", "box#1"], "--remove: not with --list, which only lists"),
        (["--list", "--seed", "4", "--save-edits", "x.json"], "--save-edits, --seed: not with --list"),
        (["--remove", "box#1"], "give --out FILE"),
        (["--remove", "box#1", "--out", "x.png"], "name a memory file to write"),
        (["--remove", "box#1", "--out", "x.safetensors", "--checkpoint", "reference"], "add --camera DATA#trajectory"),
        (
            ["--remove", "box#1", "--out", "x.safetensors", "--sampler", "dpm", "--adapter", "scene"],
            "--adapter, --sampler: only with --checkpoint",
        ),
    ],
)
def test_options_that_do_not_go_together_are_refused(persist, room, options, words):
    result = persist("edit", room, *options)
    assert result.code == 1
    assert words in result.err


def test_a_corrupt_file_is_named(persist, room, tmp_path):
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(room.read_bytes()[:500])
    result = persist("edit", broken, "--list")
    assert result.code == 1
    assert str(broken) in result.err
    assert len(result.err.strip().splitlines()) == 1


def test_a_voxel_map_is_edited_by_boxes_and_a_world_model_imagines_it_before_and_after(persist, voxel, walks, tmp_path):
    memory, out = tmp_path / "map.safetensors", tmp_path / "edited.safetensors"
    assert persist("memorize", f"{walks}#0:0-8", "--checkpoint", voxel, "--out", memory).code == 0
    options = ("--paint", "-9,-9,-9:9,9,9", "red", "--camera", f"{walks}#0:6", "--checkpoint", voxel, "--steps", 1)
    result = persist("edit", memory, *options, "--out", out)
    assert result.code == 0, result.err
    assert bool((load_memory(out).points().colors == torch.tensor([255, 0, 0], dtype=torch.uint8)).all())
    assert Image.open(tmp_path / "edited-views.png").height > 200
    other = persist("edit", memory, *options, "--autoguidance", 3, "--out", tmp_path / "other.safetensors")
    assert (other.code, "this checkpoint has no guide" in other.err) == (1, True), other.err
    assert persist("edit", memory, *options[:3], "--out", tmp_path / "unseen.safetensors").code == 0
    assert (tmp_path / "unseen.safetensors").read_bytes() == out.read_bytes()
    assert "knows no classes" in persist("edit", memory, "--list").err


def test_a_camera_of_another_scene_is_refused(persist, room, walks, tmp_path):
    result = persist("edit", room, "--remove", "box#1", "--camera", f"{walks}#0:6", "--out", tmp_path / "x.safetensors")
    assert result.code == 1
    assert "the memory of 'room'" in result.err
