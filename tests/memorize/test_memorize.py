"""``persist memorize`` writes memory files from trajectories and merges them."""

from __future__ import annotations

import json
import signal
import time
from dataclasses import replace

import pytest
import torch
from PIL import Image

from persist_cli.cli.app import main
from persist_cli.data.store import Store, write_trajectory
from persist_cli.errors import RecipeError
from persist_cli.memorize.memory_config import plugin_settings
from persist_cli.memorize.memory_file import load_memory, load_paths
from tests.support.processes import start_persist, wait_until
from tests.support.room_views import MEMORIES, same_bits
from tests.support.rooms import Room, walk


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two walks through the room, and one through another scene."""
    folder = tmp_path_factory.mktemp("rooms")
    room = Room(32, 32)
    room.write(folder / "a.parquet", walk(12))
    room.write(folder / "b.parquet", walk(5))
    write_trajectory(folder / "c.parquet", replace(room.info, scene="cellar"), room.frames(walk(2)))
    return folder


def memorize(capsys, *arguments) -> dict:
    """Run ``persist memorize --json`` in this process and return the JSON that it prints."""
    capsys.readouterr()
    succeed("--json", *arguments)
    return json.loads(capsys.readouterr().out)


def succeed(*arguments) -> None:
    """Run ``persist memorize`` in this process."""
    with pytest.raises(SystemExit) as end:
        main(["memorize", *map(str, arguments)])
    assert end.value.code == 0


def failure(capsys, *arguments) -> str:
    """The one line that ``persist memorize`` ends with."""
    with pytest.raises(SystemExit) as end:
        main(["memorize", *map(str, arguments)])
    assert end.value.code == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize("name", MEMORIES)
def test_memorize_writes_the_memory_of_the_frames_and_its_map(data, tmp_path, capsys, name):
    out = tmp_path / "room.safetensors"
    result = memorize(capsys, f"{data}#a:2-9", "--memory", name, "--out", out)
    memory = load_memory(out)
    assert (result["cells"], result["frames"]) == (memory.figures().cells, 7)
    again = type(memory)(memory.settings, memory.encoder, memory.reference)
    again.write(Store(data)["a"].read(slice(2, 9)).observations)
    assert same_bits(memory, again)
    assert Image.open(tmp_path / "room.png").width > 300
    assert sorted(path.name for path in tmp_path.iterdir()) == ["room.png", "room.safetensors"]


def test_settings_reach_memory_and_encoder(data, tmp_path, capsys):
    out = tmp_path / "room.safetensors"
    settings = ["--set", "memory.cell=[0.5, 2, 0.5]", "--set", "encoder.channels=12"]
    result = memorize(capsys, f"{data}#a", *settings, "--out", out)
    assert result["channels"] == 12
    assert load_memory(out).settings.cell == (0.5, 2.0, 0.5)


def test_a_memory_of_several_trajectories_equals_their_merged_memories(data, tmp_path, capsys):
    both = memorize(capsys, f"{data}#a", f"{data}#b", "--out", tmp_path / "both.safetensors")
    parts = {name: tmp_path / f"{name}.safetensors" for name in "ab"}
    for name, part in parts.items():
        memorize(capsys, f"{data}#{name}", "--out", part)
    merged = memorize(capsys, "--merge", *parts.values(), "--out", tmp_path / "m.safetensors")
    assert merged["cells"] == both["cells"]
    assert (tmp_path / "m.safetensors").read_bytes() == (tmp_path / "both.safetensors").read_bytes()
    assert (tmp_path / "m.png").read_bytes() == (tmp_path / "both.png").read_bytes()


def test_two_parts_of_one_trajectory_are_two_paths_of_a_memory(data, tmp_path, capsys):
    memorize(capsys, f"{data}#a:0-3", f"{data}#a:3-9", "--out", tmp_path / "m.safetensors")
    paths = load_paths(tmp_path / "m.safetensors")
    poses = Store(data)["a"].poses()
    assert list(paths) == ["a", "a (2)"]
    assert torch.equal(torch.cat([*paths.values()]), poses[:9])
    memorize(
        capsys, "--merge", tmp_path / "m.safetensors", tmp_path / "m.safetensors", "--out", tmp_path / "n.safetensors"
    )
    assert list(load_paths(tmp_path / "n.safetensors")) == ["a", "a (2)"]


def test_the_printed_table_has_cells_bytes_bounds_and_rate(data, tmp_path, capsys):
    succeed(f"{data}#b", "--out", tmp_path / "room.safetensors")
    printed = capsys.readouterr().out
    words = ("cells", "observed", "imagined", "bytes", "bounds", "frames/s", "room.png")
    assert all(word in printed for word in words)


def test_a_camera_beyond_the_grid_is_named_by_trajectory_and_frame(tmp_path, capsys):
    poses = walk(300)
    poses[280, 0, 3] += 1e6
    Room(8, 8).write(tmp_path / "far.parquet", poses)
    line = failure(capsys, f"{tmp_path}#far:5-300", "--out", tmp_path / "far.safetensors")
    assert "far.parquet: frame 280: its camera lies 1,000 km" in line
    assert not (tmp_path / "far.safetensors").exists()


def test_trajectories_of_one_scene_with_other_up_axes_are_told_apart_from_other_scenes(tmp_path, capsys):
    room = Room(8, 8)
    room.write(tmp_path / "a.parquet", walk(2))
    write_trajectory(tmp_path / "b.parquet", replace(room.info, world_up=(0.0, 0.0, 1.0)), room.frames(walk(2)))
    line = failure(capsys, tmp_path, "--out", tmp_path / "m.safetensors")
    assert "their up axes differ: (0.00000, 0.00000, 1.00000) and (0.00000, 1.00000, 0.00000)" in line
    for name in "ab":
        memorize(capsys, f"{tmp_path}#{name}", "--out", tmp_path / f"{name}.safetensors")
    files = [tmp_path / f"{name}.safetensors" for name in "ab"]
    assert "differ in up axis" in failure(capsys, "--merge", *files, "--out", tmp_path / "m.safetensors")


def test_data_that_cannot_be_memorized_is_refused_in_one_line(data, tmp_path, capsys):
    out = ["--out", tmp_path / "room.safetensors"]
    assert "a memory holds one scene" in failure(capsys, data, *out)
    assert "has 12 frames (0-11)" in failure(capsys, f"{data}#a:0-13", *out)
    assert "no trajectory 'd'" in failure(capsys, f"{data}#d", *out)
    assert "nothing to memorize" in failure(capsys, *out)
    assert "did you mean 'cell'" in failure(capsys, f"{data}#a", "--set", "memory.cells=1", *out)
    assert "above 0" in failure(capsys, f"{data}#a", "--set", "memory.cell=[0, 1, 1]", *out)
    assert "did you mean 'voxel'" in failure(capsys, f"{data}#a", "--memory", "voxels", *out)
    assert "name a file" in failure(capsys, f"{data}#a", "--out", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_memories_that_cannot_be_merged_are_refused_in_one_line(data, tmp_path, capsys):
    for name in "ac":
        memorize(capsys, f"{data}#{name}", "--out", tmp_path / name)
    (tmp_path / "broken").write_bytes((tmp_path / "a").read_bytes()[:99])
    out = ["--out", tmp_path / "merged"]
    assert "room and cellar" in failure(capsys, "--merge", tmp_path / "a", tmp_path / "c", *out)
    assert "not a whole memory file" in failure(capsys, "--merge", tmp_path / "a", tmp_path / "broken", *out)
    assert "two memory files" in failure(capsys, "--merge", tmp_path / "a", *out)
    for option in (("--checkpoint", tmp_path), ("--set", "memory.cell=1"), ("--seed", 0), ("--fov", 60), ("--size", 9)):
        assert f"{option[0]}: not with --merge" in failure(
            capsys, "--merge", tmp_path / "a", tmp_path / "a", *option, *out
        )
    assert not (tmp_path / "merged").exists()


def test_a_seed_is_refused_where_a_scene_has_no_model(data, tmp_path, capsys):
    out = ("--memory", "scene", "--seed", 3, "--out", tmp_path / "scene")
    assert "--seed: this scene has no model that imagines" in failure(capsys, f"{data}#a", *out)
    assert not (tmp_path / "scene").exists()


def test_scenes_that_imagine_in_different_ways_are_merged_and_the_first_one_stays_as_it_imagines(
    data, tmp_path, capsys
):
    for name in "ab":
        memorize(capsys, f"{data}#{name}", "--memory", "scene", "--set", "memory.seed=1", "--out", tmp_path / name)
    other = load_memory(tmp_path / "b")
    other.settings = replace(other.settings, model="elsewhere", seed=2, steps=3, foresight=2.0)
    other.save(tmp_path / "b")
    memorize(capsys, f"{data}#a", f"{data}#b", "--memory", "scene", "--out", tmp_path / "both")
    memorize(capsys, "--merge", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "merged")
    first, both, merged = (load_memory(tmp_path / name) for name in ("a", "both", "merged"))
    assert merged.settings == first.settings
    assert torch.equal(merged.cells.classes, both.cells.classes)


@pytest.mark.parametrize(
    ("setting", "cause"),
    [
        ("memory.size=0.5", "memory.size and cannot be merged: 0.25 and 0.5"),
        (
            "memory.palette=[free, solid, outside, sofa, bed]",
            "memory.palette and cannot be merged: only one has bed, sofa",
        ),
        ("memory.palette=[free, solid, outside, a, b, c, d, e, f]", "only one has a, b, c, d, e, …"),
        ("memory.toggles=[box, solid]", "memory.toggles and cannot be merged: ('solid', 'box') and ('box', 'solid')"),
        ("encoder.classes=300", "encoder.classes and cannot be merged: 32 and 300"),
    ],
)
def test_scenes_of_other_cells_are_not_merged_and_only_the_setting_that_differs_is_named(
    data, tmp_path, capsys, setting, cause
):
    for name, settings in (("a", ()), ("b", ("--set", setting))):
        memorize(capsys, f"{data}#{name}", "--memory", "scene", *settings, "--out", tmp_path / name)
    line = failure(capsys, "--merge", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "merged")
    assert line.endswith(cause)
    assert f"{tmp_path / 'a'} and {tmp_path / 'b'}: memories differ in" in line
    assert not (tmp_path / "merged").exists()


def test_plugin_settings_go_to_memory_or_encoder_by_their_first_word():
    parsed = plugin_settings(["memory.cell=[1, 2, 3]", "encoder.seed=4", "memory.max_depth=null"])
    assert parsed == {"memory": {"cell": [1, 2, 3], "max_depth": None}, "encoder": {"seed": 4}}
    for wrong in ("cell=1", "memory.cell", "memory.=1", "camera.cell=1", "memory.cell=[1,", "memory.cell=2024-13-45"):
        with pytest.raises(RecipeError):
            plugin_settings([wrong])


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.2])
def test_killing_memorize_leaves_no_partial_file_and_it_can_run_again(data, tmp_path, capsys, delay):
    memorize(capsys, f"{data}#a", "--out", tmp_path / "expected" / "room.safetensors")
    expected = (tmp_path / "expected" / "room.safetensors").read_bytes()
    out = tmp_path / "killed" / "room.safetensors"
    out.parent.mkdir()
    process = start_persist("memorize", f"{data}#a", "--out", out)
    wait_until(lambda: any(out.parent.iterdir()), process)
    time.sleep(delay)
    process.send(signal.SIGKILL)
    process.wait()
    assert not out.exists() or out.read_bytes() == expected
    memorize(capsys, f"{data}#a", "--out", out)
    assert out.read_bytes() == expected
    assert sorted(path.name for path in out.parent.iterdir()) == ["room.png", "room.safetensors"]
