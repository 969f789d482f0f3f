"""The scene model that comes with the package is whole and small, and what it imagines are rooms."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
import torch

from persist_cli.api.actions import walking_actions
from persist_cli.api.cells import CellGrid
from persist_cli.api.ground import Body
from persist_cli.bench.scenes.connectedness import count_borders
from persist_cli.checkpoints.scene_models import TrainedSceneModel, find_scene_model, write_scene_card
from persist_cli.memorize.memory_file import load_memory
from tests.support.cell_rooms import camera_at, cell_room
from tests.support.drawn_scenes import empty_scene
from tests.support.packaged_models import check_files, check_sample_is_unseen

MOST_BYTES = 15e6


@pytest.fixture
def packaged(monkeypatch) -> TrainedSceneModel:
    """The one in the package; other tests have none, or use their own."""
    monkeypatch.delenv("PERSIST_REFERENCE")
    return find_scene_model("scene")


def test_every_file_has_its_hash_and_all_are_small(packaged):
    check_files(packaged.folder, MOST_BYTES)


def test_its_card_has_the_fingerprint_of_its_weights(packaged, tmp_path):
    copy = shutil.copytree(packaged.folder, tmp_path / "copy")
    write_scene_card(copy, packaged.plugin, packaged.settings, packaged.stage, packaged.training_scenes)
    assert find_scene_model(copy).fingerprint == packaged.fingerprint


def test_it_keeps_how_small_pieces_of_a_class_are(packaged):
    least = dict(zip(packaged.form.cells.palette, packaged.load().codec.least_cells.tolist(), strict=True))
    assert least["door"] > least["table"] > least["potion"] == least["free"] == 1


def test_it_says_itself_what_interactions_change(packaged):
    model, scene = packaged.load(), empty_scene(palette=list(packaged.form.cells.palette), evolution="model")
    scene.imagine_with(lambda: model)
    room, box = cell_room(), packaged.form.cells.palette.index("box")
    classes = torch.zeros_like(room.classes)
    for number, name in enumerate(room.form.palette):
        classes[room.classes == number] = packaged.form.cells.palette.index(name)
    scene.add(replace(room, classes=classes, form=packaged.form.cells))
    assert packaged.stage == "scene-outcome"
    assert int((scene.cells.classes == box).sum()) == 1
    pose = camera_at(room, (5, 4, 5), (9, 4, 5)).world_from_camera[0]  # a metre before the box
    assert scene.act(walking_actions()["pick_up"], pose, Body())
    assert int((scene.cells.classes == box).sum()) == 0


def test_it_was_not_trained_on_the_sample_houses(packaged):
    check_sample_is_unseen(packaged.training_scenes)


def test_it_imagines_closed_rooms_around_one_image_and_others_with_another_seed(packaged, persist, tmp_path):
    image = persist("memorize", "sample#0:20", "--memory", "scene", "--out", tmp_path / "image.safetensors")
    assert image.code == 0
    known = load_memory(tmp_path / "image.safetensors").cells
    houses = []
    for seed in (3, 4):
        out = tmp_path / f"{seed}.safetensors"
        words = ("memorize", "sample#0:20", "--memory", "scene", "--complete", "--seed", seed, "--out", out)
        assert persist(*words).code == 0
        houses.append(load_memory(out).cells)
    for house in houses:
        floor, wall = (house.classes == house.form.palette.index(name) for name in ("floor", "wall"))
        assert int(floor.sum()) > 200
        assert int(wall.sum()) > 1000
        faces = count_borders(house, known_in(house, known))
        assert faces.open < 0.3 * (faces.open + faces.closed)
    assert not torch.equal(houses[0].classes, houses[1].classes)


def known_in(house: CellGrid, known: CellGrid) -> torch.Tensor:
    """Which cells of a completed house were known after the image."""
    return known.box(house.corner, house.shape).known
