"""The files of a plan: ``plan.json``, a sheet, a map and a video."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.api.actions import format_actions
from persist_cli.api.cost import Cost
from persist_cli.api.ground import GroundMap
from persist_cli.api.memory import MapPoints
from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError
from persist_cli.io.files import empty_folder_aside, remove_leftovers, write_json
from persist_cli.output.map import DrawnCandidate, draw_candidates
from persist_cli.output.sheet import write_sheet
from persist_cli.output.video import beside, enlarge, labelled, still, write_video
from persist_cli.planning.futures import CandidateWalk, FutureModel, Imagined, WorldFutures
from persist_cli.planning.judge import Candidate
from persist_cli.planning.planners import Plan
from persist_cli.planning.true_futures import true_futures

FILES: Final = ("sheet.png", "plan.mp4", "map.png", "plan.json")

Video = UInt8[Tensor, "frame height width 3"]


@dataclass(frozen=True)
class Planned:
    """A plan with what it was made in.

    Args:
        plan: the plan.
        goal: its goal.
        cost: its cost.
        ground: what was known to be free.
        futures: the world model's futures at the start frame.
    """

    plan: Plan
    goal: Goal
    cost: Cost
    ground: GroundMap
    futures: WorldFutures

    def ranked(self) -> list[Candidate]:
        """Return all candidates, the least cost first; of equal ones the first that was judged."""
        return sorted(self.plan.candidates, key=lambda candidate: candidate.cost)


@dataclass(frozen=True)
class Shown:
    """The best candidates frame by frame.

    Args:
        candidates: the best, the chosen one first.
        imagined: what the model imagines of each.
        truth: what is really seen along each; ``None`` where it is not known.
        true_walks: where each really leads; ``None`` where it is not known.
        true_costs: cost of the true frame that counts, or of the best of them; ``None`` where it is not known.
        unknown: why the truth is not known, empty where it is.
    """

    candidates: list[Candidate]
    imagined: list[Video]
    truth: list[Video] | None
    true_walks: list[CandidateWalk] | None
    true_costs: list[float] | None
    unknown: str


def write_plan(planned: Planned, out: Path, description: dict[str, Any], best: int) -> dict[str, Any]:
    """Write all files over those of an earlier plan, or none of them; return the content of ``plan.json``.

    Args:
        planned: the plan.
        out: the folder.
        description: what it was made with, as JSON values.
        best: number of candidates on the sheet.
    """
    shown = look_at(planned, best)
    record = description | record_of(planned, shown)
    start = planned.futures.model.agents[0].now
    place = out / "plan" if out.is_dir() else out  # what is written aside lies on the same disk
    remove_leftovers(place.parent, place.name)
    with empty_folder_aside(place) as aside:
        write_sheet(aside / "sheet.png", sheet_rows(start.rgb[0], planned.goal, shown))
        write_video(aside / "plan.mp4", chosen_video(start.rgb, planned.goal, shown))
        draw(planned, aside / "map.png")
        write_json(aside / "plan.json", record)
        out.mkdir(exist_ok=True)
        for name in FILES:
            (aside / name).replace(out / name)
    return record


def look_at(planned: Planned, best: int) -> Shown:
    """Imagine the best candidates again with all of their frames, and see them in the true scene if it is known."""
    candidates = planned.ranked()[:best]
    agent = planned.futures.model.agents[0]
    imagined = videos_of(planned.futures, candidates)[0]
    true_model, unknown = true_futures(agent.now, agent.info)
    if true_model is None:
        return Shown(candidates, imagined, None, None, None, unknown)
    try:
        truth, seen = videos_of(true_model, candidates)
    except PersistError as error:  # an interaction, which walking back does not undo
        return Shown(candidates, imagined, None, None, None, str(error))
    costs = planned.cost.measured(seen.futures, planned.goal, planned.ground)
    true_costs = [float(costs[row, max(one.best - 1, 0)]) for row, one in enumerate(candidates)]
    if any(map(math.isnan, true_costs)):
        return Shown(candidates, imagined, None, None, None, f"its cost {planned.cost.name!r} is NaN")
    return Shown(candidates, truth=truth, imagined=imagined, true_walks=seen.walks, true_costs=true_costs, unknown="")


def videos_of(model: FutureModel, candidates: Sequence[Candidate]) -> tuple[list[Video], Imagined]:
    """Return the frames of candidates, one for an empty candidate, and all that the model says of them."""
    seen = model.imagine([candidate.actions for candidate in candidates], "best")
    lengths = [max(1, len(candidate.actions)) for candidate in candidates]
    return [seen.futures.rgb[row, :length] for row, length in enumerate(lengths)], seen


def sheet_rows(start: UInt8[Tensor, "height width 3"], goal: Goal, shown: Shown) -> list[tuple[str, Video]]:
    """Return the rows of the sheet: start and goal, then each of the best candidates, imagined and as it really is."""
    first = ("start", start[None]) if goal.rgb is None else ("start, goal", torch.stack([start, goal.rgb]))
    rows = [first]
    for number, (candidate, video) in enumerate(zip(shown.candidates, shown.imagined, strict=True)):
        rows.append((f"{number + 1}. imagined, cost {candidate.cost:.3f}", video))
        if shown.truth is not None and shown.true_costs is not None:
            rows.append((f"    true, cost {shown.true_costs[number]:.3f}", shown.truth[number]))
    return rows


def chosen_video(start: Video, goal: Goal, shown: Shown) -> Video:
    """Return the chosen candidate's imagined frames up to the one that counts, beside what is known of the rest."""
    count = shown.candidates[0].best
    videos = [("imagined", torch.cat([start, shown.imagined[0][:count]]))]
    if shown.truth is not None:
        videos.append(("true", torch.cat([start, shown.truth[0][:count]])))
    if goal.rgb is not None:
        videos.append(("goal", still(goal.rgb, count + 1)))
    return beside([labelled(enlarge(video), label) for label, video in videos])


def draw(planned: Planned, path: Path) -> None:
    """Draw all candidates on the map of the memory."""
    agent = planned.futures.model.agents[0]
    start = agent.now.cameras.world_from_camera.double().cpu()
    drawn = [DrawnCandidate(torch.cat([start, one.walk.poses]), one.cost) for one in planned.ranked()]
    no_points = MapPoints(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.uint8))
    points = no_points if agent.memory is None else agent.memory.points()
    draw_candidates(points, agent.info.world_up, drawn, planned.goal.position, path)


def record_of(planned: Planned, shown: Shown) -> dict[str, Any]:
    """Return what was found, as JSON values; costs may be infinite, which ``write_json`` writes as null."""
    plan = planned.plan
    rows = [candidate_json(candidate) for candidate in planned.ranked()]
    for number, row in enumerate(rows[: len(shown.candidates)]):
        row["true_cost"] = None if shown.true_costs is None else shown.true_costs[number]
        row["truly_blocked"] = None if shown.true_walks is None else blocked(shown.true_walks[number])
    return {
        "actions": list(plan.actions),
        "text": format_actions(plan.actions),
        "least_cost": plan.best.cost,
        "imagined_videos": len(plan.candidates) if planned.cost.sees else 0,
        "imagined_frames": plan.frames,
        "judged_actions": plan.judged,
        "seconds": plan.seconds,
        "ended_by_budget": plan.exhausted,
        "rounds": [round_json(plan, number) for number in range(1, plan.rounds + 1)],
        "truth": {"known": shown.truth is not None, "unknown": shown.unknown},
        "candidates": rows,
    }


def candidate_json(candidate: Candidate) -> dict[str, Any]:
    """Return a candidate as JSON values; poses are world_from_camera, blocked actions are numbered from 1.

    A cost may be infinite, as that of ``geodesic`` where there is no way; the file has null in its place.
    """
    poses = candidate.walk.poses
    return {
        "actions": format_actions(candidate.actions),
        "cost": candidate.cost,
        "best_frame": candidate.best,
        "round": candidate.round,
        "final_pose": poses[-1].tolist() if len(poses) else None,
        "blocked": blocked(candidate.walk),
        "true_cost": None,
        "truly_blocked": None,
    }


def blocked(walk: CandidateWalk) -> list[int]:
    """Return the numbers of the actions, from 1, that could not move."""
    return [number for number, free in enumerate(walk.free.tolist(), 1) if not free]


def round_json(plan: Plan, number: int) -> dict[str, Any]:
    """Return how many new candidates a round had, their mean cost, and the least cost so far."""
    new = [candidate.cost for candidate in plan.candidates if candidate.round == number]
    so_far = [candidate.cost for candidate in plan.candidates if candidate.round <= number]
    mean = math.fsum(new) / len(new) if new else None
    return {"round": number, "new_candidates": len(new), "mean_cost": mean, "least_cost": min(so_far)}
