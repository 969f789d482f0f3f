import functools
import json

import pytest
import torch

from persist_cli.data.clips import interactions_of
from persist_cli.errors import PersistError
from persist_cli.rollout.seeds import clip_seed
from persist_memory.grid.visibility import Views
from tests.support.micro_worlds import remembering_model, world_on_walk

ACTIONS = (["left"] * 8, ["left"] * 4 + ["forward"] * 4, ["right"] * 8)


@pytest.fixture(scope="module")
def backbone():
    """A micro model with an adapter, all of whose parts have an effect."""
    return remembering_model()


@pytest.fixture
def start(backbone, walks):
    """A function that makes a world model at one frame of a walk, with a memory of the frames before it."""
    return functools.partial(world_on_walk, backbone, walks)


def alike(first, second):
    """Return whether two videos differ at most by the rounding of a batch."""
    colors = (first.rgb.int() - second.rgb.int()).abs().amax() <= 1
    return bool(colors) and torch.allclose(first.depth, second.depth, rtol=1e-3, atol=1e-3)


def record_sizes(monkeypatch, owner, name):
    """Return a list that grows by the number of samples or views of each call of a method."""
    sizes, method = [], getattr(owner, name)

    def recording(*arguments):
        sizes.append(len(arguments[0].apexes if isinstance(arguments[0], Views) else arguments[0]))
        return method(*arguments)

    monkeypatch.setattr(owner, name, recording)
    return sizes


def test_a_branch_imagines_what_a_single_rollout_does(start):
    branched = [result.seen for result in start(seed=5).branches(3).step(ACTIONS)]
    single = [start(seed=5).step([names])[0].seen for names in ACTIONS]
    assert all(alike(first, second) for first, second in zip(branched, single, strict=True))
    assert not alike(branched[0], branched[1])


def test_each_clip_is_told_the_interactions_before_its_own_frames(start, monkeypatch):
    world, told = start(), []
    denoise = world.denoise
    monkeypatch.setattr(world, "denoise", lambda clips: told.append(clips.interactions) or denoise(clips))
    way = world.agents[0].cameras_after(["left"] * 10)
    for _ in world.imagine([way], [("toggle", *[None] * 7, None, "pick_up")]):
        pass
    first, second = (clips[0] for clips in told)
    assert first == ("toggle", *[None] * 7)
    assert second[:2] == (None, "pick_up")


def test_branches_whose_views_are_drawn_read_a_map_together_and_imagine_what_a_single_rollout_does(walks):
    backbone = remembering_model({"form": "rendered", "token_budget": 100_000, "attention_tokens": 0})
    begin = functools.partial(world_on_walk, backbone, walks)
    branches = begin(seed=5).branches(3)
    cameras = [agent.cameras_after(names) for agent, names in zip(branches.agents, ACTIONS, strict=True)]
    [tokens] = {id(read): read for read in branches.read_memories(branches.agents, cameras)}.values()
    assert len(tokens) > 100
    branched = [result.seen for result in begin(seed=5).branches(3).step(ACTIONS)]
    single = [begin(seed=5).step([names])[0].seen for names in ACTIONS]
    for one, other in zip(branched, single, strict=True):  # a drawn byte may round the other way
        assert (one.rgb.int() - other.rgb.int()).abs().amax() <= 1
        assert torch.allclose(one.depth, other.depth, rtol=0.02)


@pytest.mark.parametrize("kind", ["voxel", "map2d", "snapshots"])
def test_a_branch_reads_the_same_tokens_as_a_single_rollout_to_the_bit(start, kind):
    branches = start(kind).branches(3)
    vocabulary = branches.agents[0].info.vocabulary
    cameras = [agent.cameras_after(names) for agent, names in zip(branches.agents, ACTIONS, strict=True)]
    interactions = [interactions_of(names, vocabulary) for names in ACTIONS]
    branched = branches.recall(range(3), cameras, interactions)
    for number in range(3):
        single = start(kind).recall([0], cameras[number : number + 1], interactions[number : number + 1])
        mask = branched.tokens.mask[number]
        assert torch.equal(branched.tokens.features[number, mask], single.tokens.features[single.tokens.mask])
        assert torch.equal(branched.tokens.positions[number, mask], single.tokens.positions[single.tokens.mask])
        assert branched.seeds[number] == single.seeds[0]


def test_branches_encode_their_shared_frame_once_and_read_the_memory_once(start, backbone, monkeypatch):
    branches = start().branches(3)
    encoded = record_sizes(monkeypatch, backbone.codec, "encode")
    searched = record_sizes(monkeypatch, Views, "visible_distances")
    branches.step(ACTIONS)
    assert encoded == [1]
    read, written = searched[:2], searched[2:]
    assert read == [21, 21]  # blocks, then cells: the first camera and four turns to the left are the same for two
    assert written == [8, 8, 8]  # of the frames of each branch, what no observed cell shows is written
    branches.step(ACTIONS)
    assert encoded == [1, 3]  # by now each branch has a present frame of its own


def test_branches_write_into_memories_of_their_own(start):
    model = start()
    before = model.agents[0].memory.tensors()
    branches = model.branches(2)
    branches.step(ACTIONS[:2])
    first, second = (agent.memory.tensors() for agent in branches.agents)
    assert all(torch.equal(model.agents[0].memory.tensors()[name], value) for name, value in before.items())
    assert len(first["cells"]) > len(before["cells"])
    assert first["cells"].shape != second["cells"].shape or not torch.equal(first["features"], second["features"])
    model.step([["forward"]])
    assert all(torch.equal(branches.agents[0].memory.tensors()[name], value) for name, value in first.items())


def test_branches_write_with_the_errors_of_the_first_agent(start):
    written = []
    branches = start(disturb=lambda seen: written.append(len(seen)) or seen).branches(2)
    branches.step([["left"] * 8] * 2)
    assert written == [1, 8, 8]  # the first frame, and a clip of each branch


def test_branches_that_do_not_write_share_one_memory(start):
    branches = start(write=False).branches(2)
    branches.step(ACTIONS[:2])
    assert branches.agents[0].memory is branches.agents[1].memory


def test_branches_may_have_different_numbers_of_actions(start):
    actions = [["left"] * 3, ["right"] * 12]
    videos = [result.seen for result in start().branches(2).step(actions)]
    assert [len(video) for video in videos] == [3, 12]
    assert all(alike(video, start().step([names])[0].seen) for video, names in zip(videos, actions, strict=True))


def test_branching_again_does_not_change_the_first_world_model(start):
    model = start()
    branch = model.branches(1)
    branch.step([["left"] * 8])
    continued = branch.branches(2).step([["left"] * 8, ["forward"] * 8])[0].seen
    expected = start().step([["left"] * 16])[0].seen
    assert alike(continued, expected[8:])
    assert alike(model.step([["left"] * 8])[0].seen, expected[:8])


def test_each_clip_of_a_rollout_has_noise_of_its_own_and_branches_have_the_same(start, backbone, monkeypatch):
    seeds, generate = [], backbone.generate

    def recording(first, sampling):
        seeds.append(list(first.seeds))
        return generate(first, sampling)

    monkeypatch.setattr(backbone, "generate", recording)
    branches = start(seed=5).branches(2)
    branches.step([["left"] * 16] * 2)
    assert seeds == [[clip_seed(5, 0)] * 2, [clip_seed(5, 1)] * 2]


def test_each_seed_and_clip_has_noise_of_its_own_beyond_32_bits_too():
    seeds = [clip_seed(seed, clip) for seed in (0, 1, 4295, 2**26, 2**31 - 1) for clip in (0, 1, 32704)]
    assert len({torch.rand(4, generator=torch.Generator().manual_seed(seed)).sum().item() for seed in seeds}) == 15


def test_branches_that_cannot_work_are_refused(start):
    model = start()
    with pytest.raises(PersistError, match="0 branches of a rollout; it must be at least 1"):
        model.branches(0)
    with pytest.raises(PersistError, match="2 agents were given 1 lists"):
        model.branches(2).step([["left"]])
    with pytest.raises(PersistError, match=r"lists of \[1, 0\] actions"):
        model.branches(2).step([["left"], []])


def test_every_list_of_actions_writes_the_folder_of_a_single_rollout(persist, voxel, walks, tmp_path):
    def roll(out, *options):
        result = persist("rollout", voxel, "--start", f"{walks}#0:2", "--out", out, "--steps", 1, *options, "--json")
        assert result.code == 0, result.err
        return json.loads(result.out)

    branched = roll(tmp_path / "both", "--actions", "left*9", "--actions", "forward*2")
    single = [roll(tmp_path / "a", "--actions", "left*9"), roll(tmp_path / "b", "--actions", "forward*2")]
    assert [figures["plan"]["actions"] for figures in branched] == ["left*9", "forward*2"]
    assert [figures["frames"] for figures in branched] == [9, 2]
    for number, folder in enumerate("ab"):
        files = {path.name for path in (tmp_path / folder).iterdir()}
        assert files == {path.name for path in (tmp_path / "both" / str(number)).iterdir()}
        assert branched[number]["memory"]["cells"] == single[number]["memory"]["cells"]
        assert set(branched[number]) == set(single[number]) | {"together"}


def test_branches_refuse_a_folder_with_a_rollout_that_they_would_not_replace(persist, tmp_path, voxel, walks):
    def roll(*actions):
        options = [part for text in actions for part in ("--actions", text)]
        return persist("rollout", voxel, "--start", f"{walks}#0:2", "--out", tmp_path, "--steps", 1, *options)

    (tmp_path / "2").mkdir()
    (tmp_path / "2/rollout.json").write_text("{}")
    result = roll("left", "right")
    assert (result.code, "2: holds a rollout that these 2 would not replace" in result.err) == (1, True)
    assert not (tmp_path / "0").exists()
    assert roll("left", "right", "forward").code == 0
    result = roll("left")
    assert (result.code, "0: holds a rollout that this one would not replace" in result.err) == (1, True)
    assert not (tmp_path / "rollout.json").exists()
