"""The imagined house as an environment: what it imagines, how episodes begin, and one batch for several of them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import persist_cli.environments  # noqa: F401  registers them
from persist_cli.api.inference import SamplingOverrides
from persist_cli.errors import PersistError
from persist_cli.rollout.open_world import open_world
from tests.support.micro_runs import write_walks
from tests.support.room_worlds import RoomWorld
from tests.support.rooms import Room, walk

NAME = "persist/ImaginedHouse-v0"


@pytest.fixture
def settings(voxel, walks) -> dict[str, object]:
    """A start in the furnished room, a goal that is one of its frames, and a memory of the frames before."""
    return {
        "checkpoint": voxel, "start": f"{walks}#0:6", "goal": f"{walks}#0:0-9", "memory": f"{walks}#0:0-6",
        "sampling": {"steps": 1}, "success_radius": 0.1, "goal_distance": [0.15, 5.0],
    }  # fmt: skip


def make(settings: dict[str, object], **changes: object) -> gymnasium.Env:
    return gymnasium.make(NAME, **settings | changes)


def test_the_checker_of_gymnasium_finds_nothing(settings):
    check_env(make(settings).unwrapped)


def test_a_step_shows_what_the_world_model_imagines(settings, persist, voxel, walks, tmp_path):
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-6", "--checkpoint", voxel, "--out", memory).code == 0
    env = make(settings)
    env.reset(seed=0)
    seed = env.unwrapped.scenes._agents[0].seed
    world = open_world(f"{walks}#0:6", voxel, memory=memory, sampling=SamplingOverrides(steps=1), seed=seed)
    for action, name in ((1, "left"), (0, "forward"), (2, "right")):
        seen = env.step(action)[0]
        (expected,) = world.step([[name]])
        assert np.array_equal(seen["rgb"], expected.seen.rgb[0].numpy())
        assert np.array_equal(seen["depth"], expected.seen.depth[0].numpy())


def test_a_memory_file_is_the_same_as_the_frames_that_it_was_made_of(settings, persist, voxel, walks, tmp_path):
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-6", "--checkpoint", voxel, "--out", memory).code == 0
    frames, file = make(settings), make(settings, memory=memory)
    frames.reset(seed=1)
    file.reset(seed=1)
    assert np.array_equal(frames.step(1)[0]["rgb"], file.step(1)[0]["rgb"])


def test_each_episode_begins_with_the_memory_as_it_was_given(settings):
    env = make(settings)
    first = env.reset(seed=3)[0], env.step(1)[0]
    given = env.unwrapped.scenes.first.memory.figures()
    for action in (0, 1, 1):
        env.step(action)
    assert env.unwrapped.scenes._agents[0].memory.figures() != given
    again = env.reset(seed=3)[0], env.step(1)[0]
    assert env.unwrapped.scenes.first.memory.figures() == given
    assert all(np.array_equal(one["rgb"], two["rgb"]) for one, two in zip(first, again, strict=True))


def test_each_episode_has_noise_of_its_own(settings):
    env, seeds = make(settings), set()
    for seed in (0, 1, None):
        env.reset(seed=seed)
        seeds.add(env.unwrapped.scenes._agents[0].seed)
    assert len(seeds) == 3


def test_without_writing_the_given_frames_are_remembered_and_nothing_that_is_imagined(settings):
    writes, reads = make(settings), make(settings, write=False)
    given = writes.unwrapped.scenes.first.memory.figures()
    assert given.cells > 0
    assert reads.unwrapped.scenes.first.memory.figures() == given
    for env in (writes, reads):
        env.reset(seed=3)
    first, second = (env.unwrapped.scenes._agents[0].memory for env in (writes, reads))
    start = second.figures()
    assert start == first.figures()
    for action in (0, 1, 1):
        reads.step(action)
    assert second.figures() == start


def test_an_agent_that_walks_straight_on_stops_at_the_wall_and_pays_for_it(packaged):
    env, ghost = (gymnasium.make(**packaged, collide=collide).unwrapped for collide in (True, False))
    for one in (env, ghost):
        one.scenes.world = RoomWorld([])  # imagines the room as it is
        one.reset(seed=0)
    steps = [(env.step(0), ghost.step(0)) for _ in range(20)]
    assert np.abs(env.attempt.now.world_from_camera[[0, 2], 3]).max() < 2.5
    assert np.abs(ghost.attempt.now.world_from_camera[[0, 2], 3]).max() > 2.5
    (_, reward, *_, info), (*_, through) = steps[-1]
    assert reward == pytest.approx(-0.01 - 0.05)
    assert (info["collisions"] > 0, through["collisions"]) == (True, 0)


def test_a_chunk_of_actions_is_seen_as_one_clip(settings):
    env = make(settings, chunk=3, success_radius=0.01, goal_distance=[0.02, 5.0])
    assert env.action_space == gymnasium.spaces.MultiDiscrete([3, 3, 3])
    env.reset(seed=0)
    env.step(np.array([1, 1, 0]))
    assert env.unwrapped.scenes._agents[0].clips == 1


@pytest.mark.parametrize(("chunk", "asked", "frames"), [(1, None, 2), (3, None, 4), (20, None, 9), (1, 5, 5)])
def test_clips_are_no_longer_than_a_step_needs_unless_asked_for(packaged, chunk, asked, frames):
    env = gymnasium.make(**packaged, chunk=chunk, clip_frames=asked).unwrapped
    assert env.scenes.world.clip_frames == frames


def test_clips_that_the_model_cannot_make_are_refused_in_one_line(packaged):
    with pytest.raises(PersistError, match=r"^clips of 10 frames, .* makes clips of 2 to 9 frames$"):
        gymnasium.make(**packaged, clip_frames=10)


def test_a_vector_is_equal_to_single_environments_with_its_seeds(settings):
    vector = gymnasium.make_vec(
        NAME, num_envs=2, max_episode_steps=2, vectorization_mode="vector_entry_point", **settings
    )
    singles = [make(settings, max_episode_steps=2) for _ in range(2)]
    seen = vector.reset(seed=5)[0]
    alone = [env.reset(seed=5 + number)[0] for number, env in enumerate(singles)]
    for step in range(4):
        assert all(is_alike(seen, number, alone[number]) for number in range(2))
        actions = np.array([1 + step % 2, 2 - step % 2])
        seen, rewards, _, truncated, infos = vector.step(actions)
        for number, env in enumerate(singles):
            alone[number], reward, _, over, info = env.step(actions[number])
            assert (rewards[number], truncated[number]) == (pytest.approx(reward), over)
            if over:
                assert is_alike(infos["final_obs"], number, alone[number])
                assert infos["final_info"]["distance"][number] == pytest.approx(info["distance"])
                alone[number] = env.reset()[0]


def is_alike(batch: object, number: int, alone: dict[str, np.ndarray]) -> bool:
    """Whether an observation of a batch differs from the one alone at most by the rounding of a batch."""
    row = batch[number] if isinstance(batch, np.ndarray) else {name: batch[name][number] for name in batch}
    colors = np.abs(row["rgb"].astype(int) - alone["rgb"]).max() <= 1
    return bool(colors) and all(np.allclose(row[name], alone[name], rtol=1e-3, atol=1e-3) for name in ("depth", "pose"))


def test_random_goals_lie_on_free_ground_that_was_seen(settings):
    env = make(settings, goal="random", observe_goal="place", collide=True)
    known = env.unwrapped.scenes.known
    places = set()
    for seed in range(5):
        env.reset(seed=seed)
        position = env.unwrapped.attempt.goal.position
        assert int(known.ground.at(known.ground.places(position))) == 1
        places.add(tuple(position.tolist()))
    assert len(places) > 1


def test_a_goal_image_of_another_size_is_resized_and_said_so(settings, tmp_path, capsys):
    env = make(settings, goal=f"{write_walks(tmp_path, size=64)}#0:0-9")
    assert "resized from 64x64 to 32x32 pixels" in capsys.readouterr().err
    seen, expected = (one.reset(seed=0)[0]["goal"].astype(int) for one in (env, make(settings)))
    assert np.abs(seen - expected).mean() < 20


def test_a_start_is_drawn_where_several_are_named(settings, walks):
    env = make(settings, start=f"{walks}#0:4-9")
    starts = {env.reset(seed=seed)[0]["rgb"].tobytes() for seed in range(8)}
    assert len(starts) > 1


def test_a_goal_where_the_agent_stands_is_an_error(settings, walks):
    with pytest.raises(PersistError, match=r"its goal is within the success_radius of 0\.1 m"):
        make(settings, goal=f"{walks}#0:6").reset(seed=0)


def test_settings_that_do_not_go_together_are_one_line(settings, walks, tmp_path):
    picture = tmp_path / "goal.png"
    picture.write_bytes(b"")
    capture = Room(32, 32).write(tmp_path / "capture" / "room.parquet", walk(4)).parent
    for changes, words in (
        ({"goal": f"{walks}#1:0"}, "is of scene 'room-1', and the start of 'room-0'"),
        ({"memory": f"{walks}#1:0-6"}, "is of scene 'room-1', and the start of 'room-0'"),
        ({"goal": [0.0, 1.3, 0.0]}, "a place has no image; give observe_goal='place'"),
        (
            {"goal": [0.0, 1.3, 200.0], "observe_goal": "place"},
            r"\(0.0, 1.3, 200.0\): \d+ m from all that is known",
        ),
        ({"goal": str(picture)}, "an image does not say where it was taken"),
        ({"goal": "random", "observe_goal": "place"}, "goal 'random': no free ground is known"),  # no height is told
        ({"goal": "seen", "observe_goal": "place"}, "goal 'seen': no free ground is known"),
        ({"goal": "seen"}, "a place has no image; give observe_goal='place'"),
        ({"adapter": "stage1"}, "without a memory adapter it cannot read"),
        ({"start": str(capture), "memory": None, "goal": str(capture)}, "have no motion of their own"),
        ({"memry": "m"}, "unknown key 'memry', did you mean 'memory'"),
        ({"checkpoint": tmp_path}, "no checkpoint there"),
    ):
        with pytest.raises(PersistError, match=words) as caught:
            make(settings, **changes)
        assert "\n" not in str(caught.value)


def test_a_start_must_be_named():
    with pytest.raises(PersistError, match="start is missing"):
        gymnasium.make(NAME, goal="random")
