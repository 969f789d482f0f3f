"""Do cameras, depth and poses agree, and if not, which mistake of conventions explains it?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import camera_rays
from persist_cli.api.observations import Observations
from persist_cli.data.check.reprojection import Disagreement, reproject, spread

UNITS = {  # what mends the depth, and whose fault it may be
    1000.0: "divided by 1000 twice?",
    0.001: "millimetres taken for metres?",
    100.0: "divided by 100 twice?",
    0.01: "centimetres taken for metres?",
    10.0: "",
    0.1: "",
    5.0: "millimetres divided by 5000?",
    0.2: "TUM depth, 5000 to the metre, divided by 1000?",
}

RATIOS = (0.25, 0.33, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0, 2.5, 3.0, 4.0)

GROSS = (0.2, 0.5, 2.0, 5.0)


@dataclass(frozen=True)
class Hypothesis:
    """A fault that the data may have.

    Args:
        name: of the kind of fault; what the report's ``undecided`` lists.
        cause: one sentence for people, with what to do.
        undo: mends a pair of frames that has this fault.
        gross: the fault is so large that data which cannot tell it apart tell nothing about its kind.
    """

    name: str
    cause: str
    undo: Callable[[Observations], Observations]
    gross: bool = True


def hypotheses(cameras: Cameras) -> list[Hypothesis]:
    """Every fault that is tried on frames of these cameras."""
    return [*_poses(), _along_the_ray(), *_scales(), *_intrinsics(cameras)]


def _poses() -> list[Hypothesis]:
    inverted = "the poses look inverted: they are camera_from_world, invert them"
    opengl = "the camera axes look like OpenGL's (y up, z backward): flip the y and z columns of the poses"
    both = f"{inverted}; and {opengl}"
    return [
        Hypothesis("inverted poses", inverted, partial(_with_poses, change=invert_rigid)),
        Hypothesis("OpenGL axes", opengl, partial(_with_poses, change=_flip)),
        Hypothesis("inverted poses", both, partial(_with_poses, change=lambda poses: _flip(invert_rigid(poses)))),
    ]


def _along_the_ray() -> Hypothesis:
    cause = "the depth looks measured along the ray: divide it by the length of K⁻¹(u, v, 1) to get planar z"
    return Hypothesis("depth along the ray", cause, _planar)


def _scales() -> list[Hypothesis]:
    """The usual units and any other ratio."""
    found = []
    for scale in (*UNITS, *RATIOS):
        size = f"{scale:g} times too small" if scale > 1 else f"{round(1 / scale, 2):g} times too large"
        hint = f" ({UNITS[scale]})" if UNITS.get(scale) else ""
        cause = f"the depth looks {size} for the positions{hint}: multiply it by {scale:g}"
        found.append(Hypothesis("depth units", cause, partial(_scaled, scale=scale), scale in GROSS))
    return found


def _intrinsics(cameras: Cameras) -> list[Hypothesis]:
    """The image size at which the principal point would be central, and any other ratio."""
    matrix = cameras.intrinsics[0]
    width, height = 2 * float(matrix[0, 2]), 2 * float(matrix[1, 2])
    found = []
    if width > 1 and height > 1 and abs(width / cameras.width - 1) > 0.05:
        found.append(_resized(cameras, cameras.width / width, cameras.height / height))
    return found + [_resized(cameras, ratio, ratio) for ratio in RATIOS]


def _resized(cameras: Cameras, x: float, y: float) -> Hypothesis:
    size = f"{round(cameras.height / y)}×{round(cameras.width / x)}"
    cause = (
        f"the intrinsics look made for images of about {size}, these are {cameras.height}×{cameras.width}: "
        f"multiply their first row by {x:.3g} and their second by {y:.3g}"
    )
    return Hypothesis("intrinsics of another size", cause, partial(_with_intrinsics, x=x, y=y), x in GROSS)


def _with_poses(pair: Observations, change: Callable[[torch.Tensor], torch.Tensor]) -> Observations:
    return replace(pair, cameras=replace(pair.cameras, world_from_camera=change(pair.cameras.world_from_camera)))


def _flip(poses: torch.Tensor) -> torch.Tensor:
    return poses @ torch.diag(poses.new_tensor([1.0, -1.0, -1.0, 1.0]))


def _planar(pair: Observations) -> Observations:
    return replace(pair, depth=(pair.depth / camera_rays(pair.cameras).norm(dim=-1)).float())


def _scaled(pair: Observations, scale: float) -> Observations:
    return replace(pair, depth=pair.depth * scale)


def _with_intrinsics(pair: Observations, x: float, y: float) -> Observations:
    scale = pair.cameras.intrinsics.new_tensor([x, y, 1.0])[:, None]
    return replace(pair, cameras=replace(pair.cameras, intrinsics=pair.cameras.intrinsics * scale))


# Real Kinect data (7-Scenes kitchen) has a median relative error of 0.006 and a depth score of 0.08, where a wrong
# hypothesis scores at least 0.11; exact renderings score 0.01. With any fault of the list the score is 0.19 to 1,
# and falls to that of good data when the fault is undone.
CUT = 0.2  # relative error that counts as 1, no agreement at all: occlusions shall count alike for all hypotheses

LEAST_SEEN = 0.1  # part of the first frame's points that the second must see

BAD_MEDIAN = 0.05  # relative error: eight times what a Kinect shows

CLEAR_RATIO = 0.6  # a fault is named when undoing it leaves less than this of the score ...

CLEAR_STEP = 0.03  # ... and takes at least this off

CLEAR_COLOR = 5.0  # levels of 255 that undoing must take off where depth does not decide

SAME_DEPTH = 0.01  # depth scores that differ less do not decide; Kinect noise moves them by about this

NEAREST = 0.05  # metres: no camera looks at a place so near

MOST_TRIED = 24  # pairs that the hypotheses are tried on

OK, SUSPICIOUS, UNKNOWN = "ok", "suspicious", "cannot tell"

NO_DEPTH = (
    "there is no depth at all: every pixel is missing, as when millimetres were taken for metres "
    "(beyond 65.535 m counts as missing)"
)

UNEXPLAINED = (
    "depth and poses disagree and no single known fault explains it: check that every pose belongs to its image "
    "(times, order) and that nothing but the camera moves"
)

TOO_NEAR = "the median depth is {:.4f} m: the depth units look wrong (divided by 1000 twice?)"

NO_OVERLAP = "the frames of a pair do not see the same place, as they are or with any known fault undone"

NO_MOTION = "the camera does not move, so nothing can be compared"


@dataclass(frozen=True)
class Score:
    """How badly pairs of frames agree.

    Args:
        depth: mean relative depth error cut off at ``CUT`` and divided by it: 0 to 1, 1 for pairs without overlap.
        color: mean absolute colour difference of reprojected pixels, levels of 255.
    """

    depth: float
    color: float

    def is_clearly_better_than(self, other: Score) -> bool:
        """Whether depth, or where it does not decide colour, is so much better that noise does not explain it."""
        if self.depth <= CLEAR_RATIO * other.depth and other.depth - self.depth >= CLEAR_STEP:
            return True
        same_depth = self.depth <= other.depth + SAME_DEPTH
        return same_depth and self.color <= min(CLEAR_RATIO * other.color, other.color - CLEAR_COLOR)

    @property
    def rank(self) -> tuple[int, float]:
        """Sorts the best first."""
        return round(self.depth / SAME_DEPTH), self.color


Tried = Sequence[tuple[Hypothesis, Score]]


@dataclass(frozen=True)
class Check:
    """What the convention check found.

    Args:
        verdict: ``ok``, ``suspicious`` or ``cannot tell``.
        cause: one sentence when it is not ok, empty otherwise.
        undecided: kinds of faults that this motion would not show.
        pairs: pairs reprojected.
        overlapping: how many of them see enough of the same place.
        median_metres: of the absolute depth error; ``None`` without overlap, as all below.
        p95_metres: 95 % of the points that are not occluded err less.
        median_relative: of the absolute depth error over the depth.
        occluded: part of the points that lie behind what the other frame sees.
        median_pixels: between a pixel and itself, to the other frame and back with the depth there.
        color_warped: mean absolute colour difference of reprojected pixels, levels of 255.
        color_unwarped: the same of the same pixels of both frames.
        scores: ``Score`` of the data as they are (``as is``) and of the best hypothesis of each kind.
    """

    verdict: str
    cause: str
    undecided: list[str]
    pairs: int
    overlapping: int
    median_metres: float | None
    p95_metres: float | None
    median_relative: float | None
    occluded: float | None
    median_pixels: float | None
    color_warped: float | None
    color_unwarped: float | None
    scores: dict[str, dict[str, float]]

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def check_convention(pairs: Sequence[Observations], advance: Callable[[], None] = lambda: None) -> Check:
    """Check pairs of frames against each other.

    Args:
        pairs: two frames each.
        advance: called once for each pair and hypothesis.
    """
    if not pairs:
        return _check(UNKNOWN, NO_MOTION, [])
    found = [_counted(reproject(pair), advance) for pair in pairs]
    depth = torch.cat([pair.depth[pair.depth > 0] for pair in pairs])
    if not len(depth):
        return _check(SUSPICIOUS, NO_DEPTH, found)
    if float(depth.median()) < NEAREST:
        return _check(SUSPICIOUS, TOO_NEAR.format(float(depth.median())), found)
    tried, baseline = spread(pairs, MOST_TRIED), score(spread(found, MOST_TRIED))
    scored = [
        (hypothesis, score([_counted(reproject(hypothesis.undo(pair)), advance) for pair in tried]))
        for hypothesis in hypotheses(pairs[0].cameras)
    ]
    verdict, cause = _judge(baseline, scored, found)
    undecided = _undecided(baseline, scored) if verdict == OK else []
    return _check(verdict, cause, found, undecided, _best_of_each_kind(baseline, scored))


def score(found: Sequence[Disagreement]) -> Score:
    """The score of pairs, each pair counting alike."""
    overlapping = _overlapping(found)
    depth = [float((pair.relative.abs().clamp(max=CUT) / CUT).mean()) for pair in overlapping]
    color = [float(pair.warped.mean()) for pair in overlapping]
    apart = len(found) - len(overlapping)
    return Score((sum(depth) + apart) / len(found), (sum(color) / len(color)) if color else 255.0)


def _judge(baseline: Score, scored: Tried, found: list[Disagreement]) -> tuple[str, str]:
    """Verdict and cause."""
    better = [(hypothesis, value) for hypothesis, value in scored if value.is_clearly_better_than(baseline)]
    if better:
        return SUSPICIOUS, "; or ".join(_causes(better))
    overlapping = _overlapping(found)
    if not overlapping:
        return UNKNOWN, NO_OVERLAP
    if float(_joined(overlapping, "relative").abs().median()) > BAD_MEDIAN:
        return SUSPICIOUS, UNEXPLAINED
    return OK, ""


def _causes(better: Tried) -> list[str]:
    """The causes of the hypotheses that repair the data best; of each kind the best one."""
    ranked = sorted(better, key=lambda item: item[1].rank)
    best = ranked[0][1]
    causes: dict[str, str] = {}
    for hypothesis, value in ranked:
        if value.depth <= best.depth + SAME_DEPTH and value.color <= best.color + CLEAR_COLOR:
            causes.setdefault(hypothesis.name, hypothesis.cause)
    return list(causes.values())


def _undecided(baseline: Score, scored: Tried) -> list[str]:
    """Kinds of which some gross fault, had the data had it, would not have been found."""
    kinds = [
        hypothesis.name
        for hypothesis, value in scored
        if hypothesis.gross and not baseline.is_clearly_better_than(value)
    ]
    return list(dict.fromkeys(kinds))


def _best_of_each_kind(baseline: Score, scored: Tried) -> dict[str, dict[str, float]]:
    scores = {"as is": baseline}
    for hypothesis, value in sorted(scored, key=lambda item: item[1].rank):
        scores.setdefault(hypothesis.name, value)
    return {name: {"depth": round(value.depth, 4), "color": round(value.color, 2)} for name, value in scores.items()}


def _check(
    verdict: str,
    cause: str,
    found: Sequence[Disagreement],
    undecided: Sequence[str] = (),
    scores: dict[str, dict[str, float]] | None = None,
) -> Check:
    overlapping = _overlapping(found)
    figures = _figures(overlapping) if overlapping else dict.fromkeys(FIGURES)
    return Check(verdict, cause, list(undecided), len(found), len(overlapping), scores=scores or {}, **figures)


FIGURES = (
    "median_metres", "p95_metres", "median_relative", "occluded", "median_pixels", "color_warped", "color_unwarped",
)  # fmt: skip


def _figures(found: list[Disagreement]) -> dict[str, float | None]:
    depth, hidden = _joined(found, "depth").abs(), _joined(found, "occluded")
    plain = depth[~hidden]
    values = (
        float(depth.median()),
        float(plain.quantile(0.95)) if len(plain) else None,
        float(_joined(found, "relative").abs().median()),
        float(hidden.double().mean()),
        float(_joined(found, "pixels").median()),
        float(_joined(found, "warped").mean()),
        float(_joined(found, "unwarped").mean()),
    )
    return dict(zip(FIGURES, values, strict=True))


def _overlapping(found: Sequence[Disagreement]) -> list[Disagreement]:
    return [pair for pair in found if pair.seen >= LEAST_SEEN]


def _joined(found: list[Disagreement], name: str) -> Tensor:
    return torch.cat([getattr(pair, name) for pair in found])


def _counted(found: Disagreement, advance: Callable[[], None]) -> Disagreement:
    advance()
    return found
