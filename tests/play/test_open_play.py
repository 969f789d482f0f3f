"""A walk is opened from a checkpoint, a start and memories; what does not go together is refused in one line."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.data.store import Store
from persist_cli.errors import CheckpointError, DataError, PersistError
from persist_cli.memorize.picture import PictureOptions
from persist_cli.play.open_play import PlayOptions, open_play, open_walks
from persist_cli.play.settings import PlaySettings
from persist_cli.play.start import StartOptions
from tests.support.micro_runs import SIZE, run_persist, stage

FAST = PlaySettings(steps=1)
FORWARD = frozenset({"forward"})


def opened(checkpoint, start, *, picture=None, **options):
    begin = StartOptions(str(start), picture or PictureOptions())
    return open_play(PlayOptions(checkpoint=checkpoint, begin=begin, settings=FAST, **options))


def test_a_walk_begins_at_a_frame_of_data_in_each_memory(voxel, walks):
    play = opened(voxel, f"{walks}#0:2", memories=("voxel", "stage1"))
    assert play.memories == ("voxel", "stage1")
    truth = Store(walks)[0].read([2]).observations.rgb[0]
    assert all(torch.equal(image, truth) for image in play.shown.images.values())
    assert play.advance(FORWARD).action == "forward"


@pytest.fixture(scope="module")
def distilled(walks, voxel, stage1, tmp_path_factory):
    """An adapter that is distilled to two steps, on a base that is not."""
    run = tmp_path_factory.mktemp("distilled") / "run"
    changes = [f"base={stage1}", f"adapter_from={voxel}", "memory=null", "adapter={}", "training.ema=0.99"]
    run_persist(*stage("stage2-voxel", walks, run, *changes, "distill.steps=2", "training.steps=1"))
    return run


@pytest.mark.parametrize(("own", "steps"), [(True, 2), (False, 1)])
def test_a_distilled_model_is_walked_in_by_its_own_sampler_and_steps(distilled, walks, own, steps):
    play = opened(distilled, f"{walks}#0:2", own_steps=own)
    sampling = play._walkers.worlds["voxel"].sampling
    assert (sampling.sampler, sampling.steps) == ("consistency", steps)


def test_a_view_without_adapter_that_is_not_distilled_itself_is_said_in_a_line(distilled, walks, capsys):
    opened(distilled, f"{walks}#0:2", memories=("voxel", "stage1"))
    assert "stage1: the model without an adapter is not distilled" in capsys.readouterr().err


def test_what_is_given_is_remembered_at_the_start(persist, voxel, walks, tmp_path):
    memory, frames = tmp_path / "m.safetensors", f"{walks}#0:0-12"
    assert persist("memorize", frames, "--out", memory).code == 0
    first = [
        opened(voxel, f"{walks}#0:2", given=given).advance(FORWARD).images["voxel"]
        for given in ((), (str(memory),), (frames,))
    ]
    assert torch.equal(first[1], first[2])
    assert not torch.equal(first[0], first[1])


def test_a_walk_begins_in_a_picture_with_depth(voxel, tmp_path):
    picture, depth = tmp_path / "room.png", tmp_path / "room.npy"
    Image.fromarray(np.full((48, 48, 3), 90, np.uint8)).save(picture)
    np.save(depth, np.full((48, 48), 2.0, np.float32))
    play = opened(voxel, picture, picture=PictureOptions(depth=depth))
    assert play.shown.images["voxel"].shape == (SIZE, SIZE, 3)
    assert play.advance(FORWARD).free
    with pytest.raises(DataError, match="a picture alone tells no depth; give --depth FILE"):
        opened(voxel, picture)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ("nowhere#0:1", "nowhere: no such data set folder"),
        ("{walks}#0:99", "there is no frame 99"),
        ("{walks}#0:1-3", "names 2 frames where one is wanted"),
        ("missing.png", "no such picture"),
        (__file__, "neither a data set, a picture nor a memory file"),
    ],
)
def test_an_unknown_start_is_named_in_one_line(voxel, walks, start, words):
    with pytest.raises(DataError) as error:
        opened(voxel, start.format(walks=walks))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_memories_that_do_not_fit_are_refused(persist, voxel, walks, tmp_path):
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-4", "--out", memory).code == 0
    with pytest.raises(CheckpointError, match="its reference is"):
        opened(voxel, f"{walks}#1:0", given=(str(memory),))
    with pytest.raises(CheckpointError, match="no memory adapter 'scene' in it; it has voxel"):
        opened(voxel, f"{walks}#0:0", memories=("scene",))
    with pytest.raises(CheckpointError, match="which stage1 cannot read; add 'voxel' to --memories"):
        opened(voxel, f"{walks}#0:0", memories=("stage1",), given=(str(memory),))
    with pytest.raises(CheckpointError, match="stage1 remembers no frames; name another memory in --memories"):
        opened(voxel, f"{walks}#0:0", memories=("stage1",), given=(f"{walks}#0:0-4",))
    with pytest.raises(DataError, match="is of scene 'room-1', the start of 'room-0'"):
        opened(voxel, f"{walks}#0:0", given=(f"{walks}#1:0-4",))
    with pytest.raises(PersistError, match="no checkpoint there"):
        opened(tmp_path, f"{walks}#0:0")


def test_walks_that_share_a_model_do_not_share_what_they_remember(voxel, walks):
    begin = StartOptions(f"{walks}#0:2")
    walk = open_walks(
        PlayOptions(checkpoint=voxel, begin=begin, settings=FAST, memories=("voxel",), given=(f"{walks}#0:0-3",))
    )
    one, two = walk(), walk()
    alone = [one.advance(FORWARD) for _ in range(10)]
    beside = [two.advance(FORWARD) for _ in range(10)]
    pairs = zip(alone, beside, strict=True)
    assert all(torch.equal(first.images["voxel"], second.images["voxel"]) for first, second in pairs)
