import json

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.memory import FrameOfReference
from persist_cli.data.clips import interactions_of
from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_memory.grid.visibility import Views
from tests.support.micro_model import micro, shaken

WAYS = (["left"] * 8, ["left"] * 4 + ["forward"] * 4, ["right"] * 8)


@pytest.fixture(scope="module")
def backbone():
    """A micro model with an adapter, none of whose parts says nothing."""
    backbone = micro()
    backbone.add_adapter("voxel", make_encoder("patches", {}).channels, {"width": 16, "heads": 2})
    shaken(backbone)
    return backbone


@pytest.fixture
def start(backbone, walks):
    """How to begin at one frame of a walk, with a memory of the frames before it."""
    whole = Store(walks)[0].read()

    def begin(kind="voxel", **options):
        memory = make_memory(kind, {}, make_encoder("patches", {}), FrameOfReference("room-0", whole.info.world_up))
        memory.write(whole.observations[:8])
        model = WorldModel(backbone, [Agent(memory, **options)], Sampling(2))
        model.reset([whole.observations[8:9]], [whole.info])
        return model

    return begin


def alike(one, other):
    """Whether two videos differ by the rounding of a batch at most."""
    colors = (one.rgb.int() - other.rgb.int()).abs().amax() <= 1
    return bool(colors) and torch.allclose(one.depth, other.depth, rtol=1e-3, atol=1e-3)


def counted(monkeypatch, owner, name):
    """How many samples or views each call of a method was given, as it goes on."""
    calls, method = [], getattr(owner, name)

    def counting(*arguments):
        calls.append(len(arguments[0].apexes if isinstance(arguments[0], Views) else arguments[0]))
        return method(*arguments)

    monkeypatch.setattr(owner, name, counting)
    return calls


def test_a_branch_imagines_what_a_single_rollout_does(start):
    together = start(seed=5).branches(3).step(WAYS)
    alone = [start(seed=5).step([way])[0] for way in WAYS]
    assert all(alike(one, other) for one, other in zip(together, alone, strict=True))
    assert not alike(together[0], together[1])


@pytest.mark.parametrize("kind", ["voxel", "map2d", "snapshots"])
def test_a_branch_reads_the_same_tokens_as_a_single_rollout_to_the_bit(start, kind):
    branches = start(kind).branches(3)
    vocabulary = branches.agents[0].info.vocabulary
    cameras = [agent.cameras_after(way) for agent, way in zip(branches.agents, WAYS, strict=True)]
    interactions = [interactions_of(way, vocabulary) for way in WAYS]
    together = branches.recall(range(3), cameras, interactions)
    for number in range(3):
        alone = start(kind).recall([0], cameras[number : number + 1], interactions[number : number + 1])
        there = together.tokens.mask[number]
        assert torch.equal(together.tokens.features[number, there], alone.tokens.features[alone.tokens.mask])
        assert torch.equal(together.tokens.positions[number, there], alone.tokens.positions[alone.tokens.mask])
        assert together.seeds[number] == alone.seeds[0]


def test_branches_encode_their_shared_frame_once_and_read_the_memory_once(start, backbone, monkeypatch):
    branches = start().branches(3)
    encoded = counted(monkeypatch, backbone.codec, "encode")
    looked = counted(monkeypatch, Views, "visible_distances")
    branches.step(WAYS)
    assert encoded == [1]
    assert looked == [21, 21]  # blocks, then cells: the first camera and four turns to the left are the same for two
    branches.step(WAYS)
    assert encoded == [1, 3]  # each stands at a frame of its own by now


def test_branches_write_into_memories_of_their_own(start):
    model = start()
    before = model.agents[0].memory.tensors()
    branches = model.branches(2)
    branches.step(WAYS[:2])
    held = [agent.memory.tensors() for agent in branches.agents]
    assert all(torch.equal(model.agents[0].memory.tensors()[name], value) for name, value in before.items())
    assert len(held[0]["cells"]) > len(before["cells"])
    assert held[0]["cells"].shape != held[1]["cells"].shape or not torch.equal(held[0]["features"], held[1]["features"])
    model.step([["forward"]])
    assert all(torch.equal(branches.agents[0].memory.tensors()[name], value) for name, value in held[0].items())


def test_branches_that_do_not_write_share_one_memory(start):
    branches = start(write=False).branches(2)
    branches.step(WAYS[:2])
    assert branches.agents[0].memory is branches.agents[1].memory


def test_branches_may_have_different_numbers_of_actions(start):
    ways = [["left"] * 3, ["right"] * 12]
    together = start().branches(2).step(ways)
    assert [len(seen) for seen in together] == [3, 12]
    assert all(alike(seen, start().step([way])[0]) for seen, way in zip(together, ways, strict=True))


def test_branching_again_does_not_change_the_first_world_model(start):
    model = start()
    branch = model.branches(1)
    branch.step([["left"] * 8])
    twigs = branch.branches(2)
    again = twigs.step([["left"] * 8, ["forward"] * 8])[0]
    expected = start().step([["left"] * 16])[0]
    assert alike(again, expected[8:])
    assert alike(model.step([["left"] * 8])[0], expected[:8])


def test_branches_that_cannot_work_are_refused(start):
    model = start()
    with pytest.raises(PersistError, match="0 branches of a rollout; it must be at least 1"):
        model.branches(0)
    with pytest.raises(PersistError, match="2 branches were given 1 lists"):
        model.branches(2).step([["left"]])
    with pytest.raises(PersistError, match=r"lists of \[1, 0\] actions"):
        model.branches(2).step([["left"], []])


def test_every_list_of_actions_writes_the_folder_of_a_single_rollout(persist, voxel, walks, tmp_path):
    def roll(out, *options):
        ended = persist("rollout", voxel, "--start", f"{walks}#0:2", "--out", out, "--steps", 1, *options, "--json")
        assert ended.code == 0, ended.err
        return json.loads(ended.out)

    together = roll(tmp_path / "both", "--actions", "left*9", "--actions", "forward*2")
    alone = [roll(tmp_path / "a", "--actions", "left*9"), roll(tmp_path / "b", "--actions", "forward*2")]
    assert [figures["plan"]["actions"] for figures in together] == ["left*9", "forward*2"]
    assert [figures["frames"] for figures in together] == [9, 2]
    for number, one in enumerate("ab"):
        files = {path.name for path in (tmp_path / one).iterdir()}
        assert files == {path.name for path in (tmp_path / "both" / str(number)).iterdir()}
        assert together[number]["memory"]["cells"] == alone[number]["memory"]["cells"]
        assert set(together[number]) == set(alone[number]) | {"together"}


def test_branches_refuse_a_folder_with_a_rollout_that_they_would_not_replace(persist, tmp_path, voxel, walks):
    def roll(*actions):
        options = [part for text in actions for part in ("--actions", text)]
        return persist("rollout", voxel, "--start", f"{walks}#0:2", "--out", tmp_path, "--steps", 1, *options)

    (tmp_path / "2").mkdir()
    (tmp_path / "2/rollout.json").write_text("{}")
    ended = roll("left", "right")
    assert (ended.code, "2: holds a rollout that these 2 would not replace" in ended.err) == (1, True)
    assert not (tmp_path / "0").exists()
    assert roll("left", "right", "forward").code == 0
