"""What candidates would see: imagined by a world model, or seen in the simulator itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cost import Futures
from persist_cli.api.ground import Body, GroundMap
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.data.clips import interactions_of
from persist_cli.errors import DataError
from persist_cli.rollout.surroundings import FixedSurroundings, whole_walks
from persist_cli.rollout.world_model import WorldModel

Over = Literal["last", "best"]  # which frame of a candidate is judged: its last, or the one of least cost
Actions = Sequence[str]
Pose = Float[Tensor, "4 4"]


@dataclass(frozen=True)
class CandidateWalk:
    """Where a candidate leads.

    Args:
        poses: world_from_camera after each action, metres.
        free: whether the way of each action was free; else the agent stayed where it was.
    """

    poses: Float[Tensor, "action 4 4"]
    free: Bool[Tensor, " action"]


@dataclass(frozen=True)
class Imagined:
    """What candidates would see, and where they lead.

    Args:
        futures: frames to judge: the last one of each candidate, or all, where shorter candidates repeat their last.
        walks: of each candidate, all of its actions.
    """

    futures: Futures
    walks: list[CandidateWalk]


class FutureModel(Protocol):
    """A model under which candidates are judged."""

    def imagine(self, candidates: Sequence[Actions], over: Over, sees: bool = True) -> Imagined:
        """Return what an agent would see that did the actions of each candidate from its present state.

        The state does not change. Candidates may have different lengths; an empty one sees the present frame.

        Args:
            candidates: names of actions.
            over: ``last`` for the last frame of each, ``best`` for all.
            sees: whether images are needed; else they may be left out, with height and width 0.
        """
        ...


@dataclass(frozen=True)
class PoseFutures:
    """Where candidates lead, without any image.

    Args:
        camera: the present one, with a frame axis of one.
        info: up axis and vocabulary.
        ground: what is known to be free; a move over ground known to be occupied does not move.
        body: of the agent; ``None`` for an agent that goes through walls.
    """

    camera: Cameras
    info: TrajectoryInfo
    ground: GroundMap
    body: Body | None = None

    def imagine(self, candidates: Sequence[Actions], over: Over, sees: bool = False) -> Imagined:
        """Return where the candidates lead; see ``FutureModel``.

        Raises:
            ValueError: when images are needed.
        """
        if sees:
            raise ValueError("poses alone show no images")
        walks = walk_all(self.camera, self.info, candidates, self.ground, self.body)
        return Imagined(without_images(*padded(walks, self.camera.world_from_camera[0], over)), walks)


class WorldFutures:
    """The futures that a world model imagines.

    The candidates are imagined as one batch, which encodes the present frame once and reads the memory once. Only what
    ``over`` asks for is decoded. Frames are written into a copy of the memory as long as a further clip reads it. After
    a blocked action the frame before it is seen again, as in ``WorldModel.step``, and candidates that differ in blocked
    actions alone are imagined once.

    Args:
        model: its first agent stands at the present frame.
        ground: what is known to be free; a move over ground known to be occupied does not move.
        body: of the agent; ``None`` for an agent that goes through walls.
    """

    def __init__(self, model: WorldModel, ground: GroundMap, body: Body | None = None) -> None:
        self.model, self.ground, self.body = model, ground, body

    def imagine(self, candidates: Sequence[Actions], over: Over, sees: bool = True) -> Imagined:
        """Return what the candidates would see; see ``FutureModel``."""
        agent = self.model.agents[0]
        led = PoseFutures(agent.now.cameras, agent.info, self.ground, self.body).imagine(candidates, over)
        if not sees:
            return led
        walks, poses, free = led.walks, led.futures.world_from_camera, led.futures.free
        moves = [free_actions(names, walk) for names, walk in zip(candidates, walks, strict=True)]
        seen = self._see_all({names: walk.poses[walk.free] for names, walk in zip(moves, walks, strict=True)}, over)
        chosen = [frame_numbers(walk, poses.shape[1], over) for walk in walks]
        videos = [tuple(part[numbers] for part in seen[names]) for names, numbers in zip(moves, chosen, strict=True)]
        rgb, depth = (torch.stack(parts) for parts in zip(*videos, strict=True))
        return Imagined(Futures(rgb, depth, poses, free), walks)

    def _see_all(
        self, paths: Mapping[tuple[str, ...], Float[Tensor, "action 4 4"]], over: Over
    ) -> dict[tuple[str, ...], tuple[Tensor, Tensor]]:
        """Return for each way of free actions RGB and depth of the present frame, and of those after it to judge."""
        now, length = self.model.agents[0].now, self.model.clip_frames - 1
        seen = {names: (now.rgb, now.depth) for names in paths}
        clips = {names: -(-len(names) // length) for names in paths}
        for count in sorted(set(clips.values()) - {0}):
            together = [names for names in paths if clips[names] == count]
            videos = self._see([paths[names] for names in together], together, over)
            for names, (rgb, depth) in zip(together, videos, strict=True):
                seen[names] = torch.cat([now.rgb, rgb]), torch.cat([now.depth, depth])
        return seen

    def _see(
        self, poses: Sequence[Float[Tensor, "action 4 4"]], candidates: Sequence[Actions], over: Over
    ) -> list[tuple[Tensor, Tensor]]:
        """Return RGB and depth of the frames to judge, of ways that take equally many clips."""
        branches = self.model.branches(len(poses))
        length, agents = branches.clip_frames - 1, branches.agents
        paths = [agent.now.cameras.at(way) for agent, way in zip(agents, poses, strict=True)]
        interactions = [interactions_of(names, agents[0].info.vocabulary) for names in candidates]
        lead = (max(map(len, candidates)) - 1) // length * length
        before, rest = [path[:lead] for path in paths], [path[lead:] for path in paths]
        clips = list(branches.imagine(before, [acts[:lead] for acts in interactions])) if lead else []
        for agent in agents:
            agent.write = False  # nothing reads what the last clip would write
        if over == "last":
            inputs = branches.recall(range(len(rest)), rest, [acts[lead:] for acts in interactions])
            rgb, depth = branches.denoise_frame(inputs, [len(path) for path in rest])
            return list(zip(rgb[:, None], depth[:, None], strict=True))
        clips += branches.imagine(rest, [acts[lead:] for acts in interactions])
        videos = zip(*clips, strict=True)
        return [
            (torch.cat([seen.rgb for seen in video]), torch.cat([seen.depth for seen in video])) for video in videos
        ]


class SimulatorFutures:
    """What would truly be seen: the agent walks each candidate in the simulator, and goes back.

    Args:
        simulator: has an open scene with the agent in it.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator

    def imagine(self, candidates: Sequence[Actions], over: Over, sees: bool = True) -> Imagined:
        """Return what the candidates would see; see ``FutureModel``.

        Raises:
            DataError: for an action that changes the scene, since going back does not undo it.
        """
        ground, heading = self.simulator.agent
        start = torch.from_numpy(self.simulator.observe().world_from_camera).double()
        try:
            walked = []
            for names in candidates:
                self.simulator.place(ground, heading)
                walked.append(self._walk(start, names, over if sees else None))
        finally:
            self.simulator.place(ground, heading)
        walks = [walk for walk, _ in walked]
        poses, free = padded(walks, start, over)
        if not sees:
            return Imagined(without_images(poses, free), walks)
        videos = [[*frames, *[frames[-1]] * (poses.shape[1] - len(frames))] for _, frames in walked]
        rgb = torch.from_numpy(np.stack([[frame.rgb for frame in video] for video in videos]))
        depth = torch.from_numpy(np.stack([[frame.depth for frame in video] for video in videos])).float()
        return Imagined(Futures(rgb, depth, poses, free), walks)

    def _walk(self, start: Pose, names: Actions, over: Over | None) -> tuple[CandidateWalk, list[Frame]]:
        """Do the actions from a pose; return the walk, and the frames to judge: none for ``None``."""
        info, free, poses, frames = self.simulator.info, [], [start], []
        world_up = torch.tensor(info.world_up, dtype=torch.float64)
        for number, name in enumerate(names, 1):
            if info.vocabulary[name].interaction:
                raise DataError(f"action {name!r} changes the scene, which the simulator as a model cannot undo")
            free.append(self.simulator.act(name))
            poses.append(info.vocabulary.move(poses[-1], name, world_up) if free[-1] else poses[-1])
            if over == "best" or (over == "last" and number == len(names)):
                frames.append(self.simulator.observe())
        if over is not None and not frames:
            frames.append(self.simulator.observe())
        return CandidateWalk(torch.stack(poses)[1:], torch.tensor(free, dtype=torch.bool)), frames


def walk_all(
    camera: Cameras, info: TrajectoryInfo, candidates: Sequence[Actions], ground: GroundMap, body: Body | None
) -> list[CandidateWalk]:
    """Return where candidates lead from one camera; a move over occupied ground stays where it is.

    This is the cheap check: the map as it is now, and unknown ground counts as free.

    Args:
        camera: with a frame axis of one.
        info: up axis and vocabulary.
        candidates: names of actions; ``DataError`` for one that the vocabulary lacks.
        ground: what is known to be free.
        body: of the agent; ``None`` to go through walls.
    """
    surroundings = None if body is None else FixedSurroundings(body, ground)
    return [CandidateWalk(walk.path, walk.verdicts) for walk in whole_walks(camera, info, candidates, surroundings)]


def free_actions(names: Actions, walk: CandidateWalk) -> tuple[str, ...]:
    """Return the actions of a candidate that were free."""
    return tuple(name for name, free in zip(names, walk.free.tolist(), strict=True) if free)


def frame_numbers(walk: CandidateWalk, count: int, over: Over) -> Int64[Tensor, " frame"]:
    """Return which frames of its free actions a candidate sees, 0 for the present one; ``count`` of them.

    Args:
        walk: of the candidate.
        count: number of frames to judge; shorter candidates repeat their last.
        over: with ``last`` only the last frame was imagined, which has number 1.
    """
    numbers = walk.free.cumsum(0) if len(walk.free) else torch.zeros(1, dtype=torch.int64)
    if over == "last":
        return numbers[-1:].clamp_max(1)
    return torch.cat([numbers, numbers[-1:].repeat(count - len(numbers))])


def padded(
    walks: Sequence[CandidateWalk], start: Float[Tensor, "4 4"], over: Over
) -> tuple[Float[Tensor, "candidate frame 4 4"], Bool[Tensor, "candidate frame"]]:
    """Return poses and free ways of the frames to judge; shorter walks repeat their last, empty ones the start."""
    length = 1 if over == "last" else max(1, *(len(walk.poses) for walk in walks))
    poses, free = [], []
    for walk in walks:
        path = walk.poses if len(walk.poses) else start.double()[None]
        ways = walk.free if len(walk.free) else torch.ones(1, dtype=torch.bool)
        number = torch.arange(length).clamp_max(len(path) - 1) if over == "best" else torch.tensor([len(path) - 1])
        poses.append(path[number])
        free.append(ways[number])
    return torch.stack(poses), torch.stack(free)


def without_images(poses: Float[Tensor, "candidate frame 4 4"], free: Bool[Tensor, "candidate frame"]) -> Futures:
    """Return futures of which only the poses are known."""
    count, frames = poses.shape[:2]
    return Futures(
        torch.zeros(count, frames, 0, 0, 3, dtype=torch.uint8), torch.zeros(count, frames, 0, 0), poses, free
    )
