"""A picture with its depth becomes a scene that is completed, saved and walked in."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.api.cells import CellOrigin
from persist_cli.api.geometry import unproject
from persist_cli.checkpoints.scene_models import save_scene_model
from persist_cli.data.reference import parse_reference
from persist_cli.data.store import Store
from persist_cli.memorize.build import walking_words
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.output.map import draw_map
from tests.memorize.test_memorize import failure, memorize, succeed
from tests.support.cell_rooms import FORM
from tests.support.micro_scenes import micro_model
from tests.support.rooms import Room, look

PALETTE = FORM.palette


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """A picture of the room from 1.25 m, with its depth in metres and in millimetres."""
    folder = tmp_path_factory.mktemp("hall")
    seen = Room(48, 64, 90.0).see(look((0.0, 1.25, 0.0), 0.0, 0.0))
    Image.fromarray(seen.rgb).save(folder / "hall.png")
    np.save(folder / "hall.npy", seen.depth)
    Image.fromarray(np.round(seen.depth * 1000).astype(np.uint16)).save(folder / "depth.png")
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """An untrained scene model."""
    folder = tmp_path_factory.mktemp("model")
    network = micro_model(palette=list(PALETTE), shape=[16, 16, 12])
    network.name = "scene"
    save_scene_model(network, "scene", folder, None)
    return folder


FOV = 2 * np.degrees(np.arctan(24 / 32))  # of ``hall``, from top to bottom


def test_a_picture_becomes_a_scene_and_a_frame_to_start_from(hall, tmp_path, capsys):
    out = tmp_path / "hall.safetensors"
    arguments = (hall / "hall.png", "--memory", "scene", "--fov", FOV, "--out", out)
    result = memorize(capsys, *arguments, "--depth", hall / "hall.npy")
    frame = parse_reference(result["start"]).trajectories()[0].read()
    seen = Room(48, 64, 90.0).see(look((0.0, 1.25, 0.0), 0.0, 0.0))
    points = unproject(frame.observations.depth, frame.observations.cameras)[0]
    assert np.array_equal(frame.observations.rgb[0].numpy(), seen.rgb)
    assert abs(float(points[..., 1].min())) < 0.002  # the floor lies 1.25 m below the camera
    assert frame.info.source["camera_height"] == 1.25
    again = memorize(capsys, *arguments, "--depth", hall / "depth.png")
    assert again["cells"] == result["cells"] > 300
    assert result["imagined"] == 0


def test_a_seed_makes_one_house_of_a_picture_and_another_seed_another(hall, model, tmp_path, capsys):
    def house(seed):
        out = tmp_path / f"{seed}.safetensors"
        result = memorize(
            capsys, hall / "hall.png", "--depth", hall / "hall.npy", "--fov", FOV, "--model", model, "--complete",
            "--seed", seed, "--out", out,
        )  # fmt: skip
        scene = load_memory(out)
        assert result["completed"] == scene.figures().imagined == result["imagined"] > 500
        assert scene.settings.palette == PALETTE
        assert scene.settings.seed == seed  # what it imagines later is of the same house
        return scene.cells.classes

    assert not torch.equal(house(3), house(4))
    assert torch.equal(house(3), house(3))


def test_a_model_sets_the_classes_also_where_the_reference_model_draws_others(
    hall, model, tmp_path, capsys, monkeypatch
):
    monkeypatch.delenv("PERSIST_REFERENCE")
    out, picture = tmp_path / "hall.safetensors", (hall / "hall.png", "--depth", hall / "hall.npy")
    assert memorize(capsys, *picture, "--model", model, "--complete", "--out", out)["completed"] > 500
    assert load_memory(out).settings.palette == PALETTE
    asked = memorize(capsys, *picture, "--memory", "scene", "--checkpoint", "reference", "--out", out)
    drawn = load_memory(out).settings.palette
    assert drawn != PALETTE
    assert asked["settings_of"] == memorize(capsys, *picture, "--memory", "scene", "--out", out)["settings_of"]
    assert load_memory(out).settings.palette == drawn  # neither a model nor the data know cells


def test_frames_of_data_are_completed_too_and_their_map_shows_what_is_imagined(model, tmp_path, capsys):
    Room(32, 32).write(tmp_path / "data" / "a.parquet", np.stack([look((0.0, 1.25, 0.0), 0.0, 0.0)] * 2))
    out = tmp_path / "house.safetensors"
    result = memorize(capsys, f"{tmp_path}/data#0:0", "--model", model, "--complete", "--out", out)
    assert result["memory"] == "scene"
    assert result["imagined"] > result["observed"] > 50
    scene, drawn = load_memory(out), out.with_suffix(".png").read_bytes()
    points, up, again = scene.points(), scene.reference.world_up, tmp_path / "again.png"
    draw_map(points, up, load_paths(out), again)
    assert again.read_bytes() == drawn
    draw_map(
        replace(points, origins=torch.full_like(points.origins, int(CellOrigin.OBSERVED))), up, load_paths(out), again
    )
    assert again.read_bytes() != drawn


@pytest.mark.parametrize("floor", [0.0, 1.2, -4.0])
def test_a_floor_that_is_none_is_said_with_the_one_that_was_seen(persist, model, tmp_path, floor):
    Room(32, 32).write(tmp_path / "data" / "a.parquet", np.stack([look((0.0, 1.25, 0.0), 0.0, 0.0)] * 2))
    arguments = ("--model", model, "--complete", "--set", f"memory.floor={floor}", "--out", tmp_path / "a.safetensors")
    result = persist("memorize", f"{tmp_path}/data#0:0", *arguments)
    assert result.code == 0, result.err
    warned = f"what is imagined has its floor at {floor:g} m along up, and the camera is at 1.25 m"
    assert (warned in result.err) == (floor != 0)
    assert ("--set memory.floor=0\n" in result.err) == (floor != 0)


def test_a_second_picture_takes_the_place_of_the_first_one(hall, tmp_path, capsys):
    other = tmp_path / "another.png"
    other.write_bytes((hall / "hall.png").read_bytes())
    arguments = ("--memory", "scene", "--depth", hall / "hall.npy", "--out", tmp_path / "scene.safetensors")
    for picture in (other, hall / "hall.png"):
        start = memorize(capsys, picture, *arguments)["start"]
    assert start == f"{tmp_path}/scene.frame#hall:0"
    assert [path.name for path in (tmp_path / "scene.frame").iterdir()] == ["hall.parquet"]


def test_the_command_that_walks_in_a_picture_is_printed(hall, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    out = tmp_path / "hall.safetensors"
    succeed(hall / "hall.png", "--memory", "scene", "--depth", hall / "hall.npy", "--out", out)
    text = " ".join(capsys.readouterr().out.split())
    assert f"walk in it: persist rollout --adapter scene --start {tmp_path}/hall.frame#hall:0 --memory {out}" in text
    words = walking_words("scene", out, "hall.frame#My Hall:0", None)
    assert " --start 'hall.frame#My Hall:0' --memory " in words


def test_the_command_that_walks_in_a_picture_names_an_adapter_that_there_is(voxel, tmp_path, monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    assert walking_words("points", tmp_path / "a", "a.frame#a:0", None).startswith("to walk in it, train an adapter")
    words = walking_words("voxel", tmp_path / "a", "a.frame#a:0", voxel)
    assert words.startswith(f"walk in it: persist rollout {voxel} --adapter voxel --start")


@pytest.mark.parametrize("wrong", [("--set", "memory.size=-1"), ("--model", "nowhere", "--complete")])
def test_what_fails_leaves_the_picture_of_the_scene_that_is_there(hall, persist, tmp_path, wrong):
    out, other = tmp_path / "scene.safetensors", tmp_path / "other.png"
    other.write_bytes((hall / "hall.png").read_bytes())
    options = ("--depth", hall / "hall.npy", "--memory", "scene", "--out", out)
    assert persist("memorize", hall / "hall.png", *options).code == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert persist("memorize", other, *options, *wrong).code == 1
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_walk_can_start_at_a_picture_whose_name_has_the_signs_of_a_reference(hall, tmp_path, capsys):
    picture = tmp_path / "a#b:c.png"
    picture.write_bytes((hall / "hall.png").read_bytes())
    start = memorize(
        capsys, picture, "--memory", "scene", "--depth", hall / "hall.npy", "--out", tmp_path / "scene.safetensors"
    )["start"]
    assert start == f"{tmp_path}/scene.frame#a-b-c:0"
    assert [file.name for file in Store(tmp_path / "scene.frame")] == ["a-b-c"]


@pytest.mark.parametrize("option", ["--set memory.model={}", "--model {}"])
def test_a_scene_finds_its_model_from_every_folder(hall, model, tmp_path, capsys, monkeypatch, option):
    out = tmp_path / "hall.safetensors"
    monkeypatch.chdir(model.parent)
    chosen = ("--memory", "scene", *option.format(model.name).split())
    memorize(capsys, hall / "hall.png", "--depth", hall / "hall.npy", *chosen, "--out", out)
    monkeypatch.chdir(tmp_path)
    scene = load_memory(out)
    assert scene.wanted_model == str(model)
    assert scene.complete(seed=1) > 0


def test_the_packaged_model_imagines_where_none_is_named(hall, model, tmp_path, capsys, monkeypatch):
    shutil.copytree(model, tmp_path / "home/scene")
    monkeypatch.setenv("PERSIST_REFERENCE", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    picture, out = (hall / "hall.png", "--depth", hall / "hall.npy", "--memory", "scene"), tmp_path / "out.safetensors"

    def house(*arguments):
        memorize(capsys, *picture, "--complete", "--seed", 3, *arguments, "--out", out)
        return load_memory(out)

    named, by_name, unnamed = (house(*words) for words in (("--model", model), ("--model", "scene"), ()))
    assert by_name.wanted_model == unnamed.wanted_model == "scene"
    (tmp_path / "scene").mkdir()  # which now is what the name means
    beside = house()
    assert beside.wanted_model == str(tmp_path / "home/scene")
    assert all(torch.equal(one.cells.classes, named.cells.classes) for one in (by_name, unnamed, beside))
    assert memorize(capsys, *picture, "--out", out)["imagined"] == 0
    assert load_memory(out).wanted_model is None


def test_a_scene_of_own_settings_has_the_classes_that_the_packaged_model_draws(hall, tmp_path, monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    own = ("free", "solid", "outside", "wall")
    picture = (hall / "hall.png", "--depth", hall / "hall.npy", "--memory", "scene")
    forms = []
    for index, words in enumerate(
        ((), ("--set", "memory.foresight=3"), ("--set", f"memory.palette=[{','.join(own)}]"))
    ):
        succeed(*picture, *words, "--out", tmp_path / f"{index}.safetensors")
        forms.append(load_memory(tmp_path / f"{index}.safetensors").cells.form.palette)
    assert "office_desk" in forms[0]
    assert forms == [forms[0], forms[0], own]


def test_a_model_that_never_learned_what_interactions_change_is_named(hall, tmp_path, capsys, model):
    own = tmp_path / "untaught"
    shutil.copytree(model, own)
    arguments = (hall / "hall.png", "--depth", hall / "hall.npy", "--model", own, "--complete")
    for index, asked in enumerate((("--set", "memory.evolution=model"), ())):
        succeed(*arguments, *asked, "--out", tmp_path / f"{index}.safetensors")
        said = f"{own}: this scene model has no stage scene-outcome; what interactions change is drawn by"
        assert capsys.readouterr().err.count(said) == len(asked) // 2


def test_a_picture_is_not_replaced_by_the_map_of_its_scene(hall, tmp_path, capsys):
    picture = tmp_path / "room.png"
    picture.write_bytes((hall / "hall.png").read_bytes())
    result = memorize(
        capsys, picture, "--memory", "scene", "--depth", hall / "hall.npy", "--out", tmp_path / "room.safetensors"
    )
    assert picture.read_bytes() == (hall / "hall.png").read_bytes()
    assert result["map"].endswith("room.map.png")


def test_a_picture_is_cropped_and_resized_as_a_model_needs(hall, tmp_path, capsys):
    result = memorize(
        capsys, hall / "hall.png", "--memory", "scene", "--depth", hall / "hall.npy", "--fov", FOV, "--size", 32,
        "--out", tmp_path / "small.safetensors",
    )  # fmt: skip
    frame = parse_reference(result["start"]).trajectories()[0].read().observations
    assert frame.depth.shape == (1, 32, 32)
    points = unproject(frame.depth, frame.cameras)[0]
    assert abs(float(points[..., 1].min())) < 0.05
    assert float((points[..., 2] + 2.0).abs().min()) < 0.002  # the wall at z = -2


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        ([], "give --depth FILE"),
        (["--depth", "none.npy"], "no such depth file"),
        (["--depth", "hall.png"], "is no depth"),
        (["--depth", "torn.png"], "cannot be read as depth"),
        (["--depth", "small.npy"], "differ in size"),
        (["--depth", "pickled.npy"], "cannot be read as depth"),
        (["--depth", "empty.npy"], "cannot be read as depth"),
        (["--depth", "several.npy"], "give a single array"),
        (["--depth", "torn.npy"], "cannot be read as depth"),
        (["--depth", "boastful.npy"], "cannot be read as depth"),
        (["--depth", "hall.npy", "--fov", "200"], "between 10 and 150"),
        (["--depth", "hall.npy", "--depth-model", "some"], "not both"),
        (["--depth-model", "empty"], "no usable folder"),
        (["--depth", "hall.npy", "--complete"], "no model that imagines; name a trained one by --model FOLDER"),
        (
            ["--depth", "hall.npy", "--complete", "--model", "scene"],
            "no model of scenes comes with this installation; train",
        ),
        (["--depth", "hall.npy", "--model", "nowhere"], "nowhere"),
    ],
)
def test_a_picture_that_cannot_become_a_scene_is_refused_in_one_line(
    hall, tmp_path, capsys, monkeypatch, arguments, cause
):
    (tmp_path / "torn.png").write_bytes((hall / "depth.png").read_bytes()[:200])
    np.save(tmp_path / "small.npy", np.ones((4, 4), np.float32))
    np.save(tmp_path / "pickled.npy", np.array([{}]), allow_pickle=True)
    np.savez(tmp_path / "several.npz", depth=np.ones((48, 64), np.float32))
    (tmp_path / "several.npz").rename(tmp_path / "several.npy")
    (tmp_path / "torn.npy").write_bytes((tmp_path / "several.npy").read_bytes()[:99])
    boast = {"descr": "<f4", "fortran_order": False, "shape": (2**30, 2**20)}
    with (tmp_path / "boastful.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, boast)
    (tmp_path / "empty.npy").touch()
    (tmp_path / "empty").mkdir()
    for name in ("hall.png", "hall.npy"):
        (tmp_path / name).write_bytes((hall / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    assert cause in failure(capsys, "hall.png", "--memory", "scene", *arguments, "--out", "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()


def test_other_memories_are_not_completed_and_data_have_depth_of_their_own(hall, tmp_path, capsys):
    Room(32, 32).write(tmp_path / "data" / "a.parquet", np.stack([look((0.0, 1.25, 0.0), 0.0, 0.0)]))
    data, out = f"{tmp_path}/data", tmp_path / "out.safetensors"
    assert "take --memory scene" in failure(capsys, data, "--memory", "voxel", "--complete", "--out", out)
    assert "--fov: only for a picture" in failure(capsys, data, "--memory", "scene", "--fov", 60, "--out", out)
    assert "made of one picture" in failure(capsys, hall / "hall.png", data, "--memory", "scene", "--out", out)


@pytest.mark.parametrize("option", [("--seed", 3), ("--complete",)])
def test_what_is_refused_leaves_the_frame_of_an_earlier_picture(hall, tmp_path, capsys, option):
    out, other = tmp_path / "room.safetensors", tmp_path / "other.png"
    first = ("--memory", "voxel", "--fov", FOV, "--depth", hall / "hall.npy", "--out", out)
    before = memorize(capsys, hall / "hall.png", *first)
    shutil.copy(hall / "hall.png", other)
    assert "imagines nothing" in failure(capsys, other, *first, *option)
    assert len(parse_reference(before["start"]).trajectories()[0].read().observations) == 1


def test_depth_comes_from_a_model_of_metres_and_one_without_a_unit_is_refused(hall, tmp_path, capsys):
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config, DPTImageProcessor

    backbone = Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=28, patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    for kind in ("metric", "relative"):
        config = DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 8, 8], fusion_hidden_size=8,
            head_hidden_size=4, depth_estimation_type=kind, max_depth=20,
        )  # fmt: skip
        DepthAnythingForDepthEstimation(config).save_pretrained(tmp_path / kind)
        DPTImageProcessor(size={"height": 28, "width": 28}).save_pretrained(tmp_path / kind)
    picture, out = hall / "hall.png", tmp_path / "out.safetensors"
    result = memorize(capsys, picture, "--memory", "scene", "--depth-model", tmp_path / "metric", "--out", out)
    frame = parse_reference(result["start"]).trajectories()[0].read().observations
    assert frame.depth.shape == (1, 48, 64)
    assert 0 < float(frame.depth.min()) <= float(frame.depth.max()) < 20
    refused = failure(capsys, picture, "--memory", "scene", "--depth-model", tmp_path / "relative", "--out", out)
    assert "has no unit" in refused
