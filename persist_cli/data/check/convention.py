"""The convention check: do cameras, depth and poses agree, and if not, which known mistake explains it?

Pairs of frames are reprojected as they are, and again with each known mistake undone. When undoing one of them makes
the frames agree clearly better, that mistake is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import camera_rays
from persist_cli.api.observations import Observations
from persist_cli.data.check.reprojection import ReprojectionErrors, evenly_spaced, reproject

UNITS = {  # the factor that mends the depth, and the mistake that it may come from
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
FINER = (0.8, 0.85, 0.9, 0.94, 0.97, 1.03, 1.06, 1.1, 1.15, 1.2)  # between two of the ratios
FOCAL = "focal length"
PRINCIPAL = "principal point"
OFF_CENTRE = 0.02  # of the images' width or height: nearer to each other, two principal points count as one
FAR_OFF = 0.25  # a principal point so far from the true one is a gross fault ...
GROSSLY_OFF = 0.1  # ... and one that lies this far from the images' middle may be one

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
class Hypothesis:
    """A fault that the data may have.

    Args:
        name: the kind of fault, as the report's ``undecided`` lists it.
        cause: one sentence for people, with what to do.
        undo: gives a pair of frames that has this fault as it would be without it.
        gross: the fault is so large that data which cannot tell it apart tell nothing about its kind.
    """

    name: str
    cause: str
    undo: Callable[[Observations], Observations]
    gross: bool = True


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
        """A key that sorts the best score first."""
        return round(self.depth / SAME_DEPTH), self.color


HypothesisScores = Sequence[tuple[Hypothesis, Score]]


@dataclass(frozen=True)
class ConventionCheck:
    """The result of the convention check; the figures are ``None`` when no pair overlaps.

    Args:
        verdict: ``ok``, ``suspicious`` or ``cannot tell``.
        cause: one sentence when it is not ok, empty otherwise.
        undecided: kinds of faults that this motion would not show.
        pairs: number of pairs that were reprojected.
        overlapping: number of pairs that see enough of the same place.
        median_metres: median of the absolute depth error.
        p95_metres: 95 % of the points that are not occluded have a smaller absolute depth error.
        median_relative: median of the absolute depth error over the depth.
        occluded: part of the points that lie behind what the other frame sees.
        median_pixels: median distance between a pixel and where it comes back, to the other frame and back.
        color_warped: mean absolute colour difference of reprojected pixels, levels of 255.
        color_unwarped: mean absolute colour difference of equal pixels of both frames, levels of 255.
        scores: ``Score`` of the data as they are (``as is``) and of the best hypothesis of each kind.
    """

    verdict: str
    cause: str
    undecided: list[str]
    pairs: int
    overlapping: int
    median_metres: float | None = None
    p95_metres: float | None = None
    median_relative: float | None = None
    occluded: float | None = None
    median_pixels: float | None = None
    color_warped: float | None = None
    color_unwarped: float | None = None
    scores: dict[str, dict[str, float]] = field(default_factory=dict)


def check_convention(pairs: Sequence[Observations], advance: Callable[[], None] = lambda: None) -> ConventionCheck:
    """Check pairs of frames against each other.

    Args:
        pairs: observations of two frames each.
        advance: called once for each pair and hypothesis, for a progress bar.
    """
    if not pairs:
        return _check(UNKNOWN, NO_MOTION, [])
    errors = _reproject_all(pairs, advance)
    depth = torch.cat([pair.depth[pair.depth > 0] for pair in pairs])
    if not len(depth):
        return _check(SUSPICIOUS, NO_DEPTH, errors)
    if float(depth.median()) < NEAREST:
        return _check(SUSPICIOUS, TOO_NEAR.format(float(depth.median())), errors)
    baseline = score(evenly_spaced(errors, MOST_TRIED))
    tried = evenly_spaced(pairs, MOST_TRIED)
    scored = [
        (hypothesis, score(_reproject_all((hypothesis.undo(pair) for pair in tried), advance)))
        for hypothesis in hypotheses(pairs[0].cameras)
    ]
    scored += [
        (hypothesis, score(_reproject_all((hypothesis.undo(pair) for pair in tried), lambda: None)))
        for hypothesis in _finer_focal_lengths(baseline, scored, pairs[0].cameras)
    ]
    verdict, cause = _judge(baseline, scored, errors)
    undecided = _undecided(baseline, scored) if verdict == OK else []
    return _check(verdict, cause, errors, undecided, _best_of_each_kind(baseline, scored))


def score(errors: Sequence[ReprojectionErrors]) -> Score:
    """The score of pairs, each pair counting alike."""
    overlapping = _overlapping(errors)
    depth = [float((pair.relative.abs().clamp(max=CUT) / CUT).mean()) for pair in overlapping]
    color = [float(pair.warped.mean()) for pair in overlapping]
    apart = len(errors) - len(overlapping)
    return Score((sum(depth) + apart) / len(errors), (sum(color) / len(color)) if color else 255.0)


def hypotheses(cameras: Cameras) -> list[Hypothesis]:
    """Every fault that is tried on frames of these cameras."""
    focal = [_scaled_focal_length(cameras, ratio) for ratio in RATIOS]
    intrinsics = [*_intrinsics_of_another_size(cameras), *_principal_points(cameras), *focal]
    return [*_pose_faults(), _depth_along_the_ray(), *_depth_units(), *intrinsics]


def _reproject_all(pairs: Iterable[Observations], advance: Callable[[], None]) -> list[ReprojectionErrors]:
    errors = []
    for pair in pairs:
        errors.append(reproject(pair))
        advance()
    return errors


def _overlapping(errors: Sequence[ReprojectionErrors]) -> list[ReprojectionErrors]:
    return [pair for pair in errors if pair.seen >= LEAST_SEEN]


def _judge(baseline: Score, scored: HypothesisScores, errors: list[ReprojectionErrors]) -> tuple[str, str]:
    """Verdict and cause."""
    better = [(hypothesis, value) for hypothesis, value in scored if value.is_clearly_better_than(baseline)]
    if better:
        return SUSPICIOUS, "; or ".join(_causes(better))
    overlapping = _overlapping(errors)
    if not overlapping:
        return UNKNOWN, NO_OVERLAP
    if float(torch.cat([pair.relative for pair in overlapping]).abs().median()) > BAD_MEDIAN:
        return SUSPICIOUS, UNEXPLAINED
    return OK, ""


def _causes(better: HypothesisScores) -> list[str]:
    """The causes of the hypotheses that repair the data best; of each kind the best one."""
    ranked = sorted(better, key=lambda item: item[1].rank)
    best = ranked[0][1]
    causes: dict[str, str] = {}
    for hypothesis, value in ranked:
        if value.depth <= best.depth + SAME_DEPTH and value.color <= best.color + CLEAR_COLOR:
            causes.setdefault(hypothesis.name, hypothesis.cause)
    return list(causes.values())


def _undecided(baseline: Score, scored: HypothesisScores) -> list[str]:
    """Kinds of faults that the data would not show, not even a gross one."""
    kinds = [
        hypothesis.name
        for hypothesis, value in scored
        if hypothesis.gross and not baseline.is_clearly_better_than(value)
    ]
    return list(dict.fromkeys(kinds))


def _best_of_each_kind(baseline: Score, scored: HypothesisScores) -> dict[str, dict[str, float]]:
    scores = {"as is": baseline}
    for hypothesis, value in sorted(scored, key=lambda item: item[1].rank):
        scores.setdefault(hypothesis.name, value)
    return {name: {"depth": round(value.depth, 4), "color": round(value.color, 2)} for name, value in scores.items()}


def _check(
    verdict: str,
    cause: str,
    errors: Sequence[ReprojectionErrors],
    undecided: Sequence[str] = (),
    scores: dict[str, dict[str, float]] | None = None,
) -> ConventionCheck:
    check = ConventionCheck(verdict, cause, list(undecided), len(errors), 0, scores=scores or {})
    overlapping = _overlapping(errors)
    if not overlapping:
        return check
    depth = torch.cat([pair.depth for pair in overlapping]).abs()
    occluded = torch.cat([pair.occluded for pair in overlapping])
    plain = depth[~occluded]
    return replace(
        check,
        overlapping=len(overlapping),
        median_metres=float(depth.median()),
        p95_metres=float(plain.quantile(0.95)) if len(plain) else None,
        median_relative=float(torch.cat([pair.relative for pair in overlapping]).abs().median()),
        occluded=float(occluded.double().mean()),
        median_pixels=float(torch.cat([pair.pixels for pair in overlapping]).median()),
        color_warped=float(torch.cat([pair.warped for pair in overlapping]).mean()),
        color_unwarped=float(torch.cat([pair.unwarped for pair in overlapping]).mean()),
    )


def _pose_faults() -> list[Hypothesis]:
    inverted = "the poses look inverted: they are camera_from_world, invert them"
    opengl = "the camera axes look like OpenGL's (y up, z backward): flip the y and z columns of the poses"
    both = f"{inverted}; and {opengl}"
    return [
        Hypothesis("inverted poses", inverted, partial(_with_poses, change=invert_rigid)),
        Hypothesis("OpenGL axes", opengl, partial(_with_poses, change=_flip)),
        Hypothesis("inverted poses", both, partial(_with_poses, change=lambda poses: _flip(invert_rigid(poses)))),
    ]


def _depth_along_the_ray() -> Hypothesis:
    cause = "the depth looks measured along the ray: divide it by the length of K⁻¹(u, v, 1) to get planar z"
    return Hypothesis("depth along the ray", cause, _with_planar_depth)


def _depth_units() -> list[Hypothesis]:
    """Depth in each of the usual units, and off by any other ratio."""
    faults = []
    for scale in (*UNITS, *RATIOS):
        size = f"{scale:g} times too small" if scale > 1 else f"{round(1 / scale, 2):g} times too large"
        hint = f" ({UNITS[scale]})" if UNITS.get(scale) else ""
        cause = f"the depth looks {size} for the positions{hint}: multiply it by {scale:g}"
        faults.append(Hypothesis("depth units", cause, partial(_with_scaled_depth, scale=scale), scale in GROSS))
    return faults


def _intrinsics_of_another_size(cameras: Cameras) -> list[Hypothesis]:
    """Intrinsics of the image size at which the principal point would be central, and off by any other ratio."""
    matrix = cameras.intrinsics[0]
    width, height = 2 * float(matrix[0, 2]), 2 * float(matrix[1, 2])
    ratios = [(ratio, ratio) for ratio in RATIOS]
    if width > 1 and height > 1 and abs(width / cameras.width - 1) > 0.05:
        ratios.insert(0, (cameras.width / width, cameras.height / height))
    return [_scaled_intrinsics(cameras, x, y) for x, y in ratios]


def _scaled_intrinsics(cameras: Cameras, x: float, y: float) -> Hypothesis:
    size = f"{round(cameras.height / y)}×{round(cameras.width / x)}"
    cause = (
        f"the intrinsics look made for images of about {size}, these are {cameras.height}×{cameras.width}: "
        f"multiply their first row by {x:.3g} and their second by {y:.3g}"
    )
    return Hypothesis("intrinsics of another size", cause, partial(_with_scaled_intrinsics, x=x, y=y), x in GROSS)


def _principal_points(cameras: Cameras) -> list[Hypothesis]:
    """The two numbers exchanged, the middle of the images, and places far off along each axis."""
    x, y = (float(value) for value in cameras.intrinsics[0, :2, 2])
    width, height, middle = cameras.width, cameras.height, (cameras.width / 2, cameras.height / 2)
    here = f"({x:.4g}, {y:.4g}) in images of {height}×{width} (height×width)"
    faults = []
    if _apart((x, y), (y, x), cameras) > OFF_CENTRE:
        cause = f"cx and cy look exchanged, the principal point is {here}: exchange them"
        faults.append(_principal_point(cause, (y, x), cameras))
    if _apart((x, y), middle, cameras) > OFF_CENTRE and not (faults and _apart((y, x), middle, cameras) <= OFF_CENTRE):
        cause = f"the principal point looks wrong, {here}: take their middle, cx = {middle[0]:g} and cy = {middle[1]:g}"
        faults.append(_principal_point(cause, middle, cameras))
    for across, down in ((FAR_OFF, 0), (-FAR_OFF, 0), (0, FAR_OFF), (0, -FAR_OFF)):
        place = x + across * width, y + down * height
        cause = f"the principal point looks wrong, {here}: it should lie at about ({place[0]:.3g}, {place[1]:.3g})"
        faults.append(_principal_point(cause, place, cameras))
    return faults


def _principal_point(cause: str, place: tuple[float, float], cameras: Cameras) -> Hypothesis:
    """The fault of a principal point that should lie at ``place``."""
    x, y = (float(value) for value in cameras.intrinsics[0, :2, 2])
    is_gross = _apart((x, y), place, cameras) > GROSSLY_OFF
    return Hypothesis(PRINCIPAL, cause, partial(_with_principal_point, place=place), is_gross)


def _apart(one: tuple[float, float], other: tuple[float, float], cameras: Cameras) -> float:
    """How far two pixels (u, v) are apart along the axis on which it is more, as a share of the images' size."""
    return max(abs(one[0] - other[0]) / cameras.width, abs(one[1] - other[1]) / cameras.height)


def _scaled_focal_length(cameras: Cameras, ratio: float) -> Hypothesis:
    focal = float(cameras.intrinsics[0, 0, 0])
    now, then = (math.degrees(2 * math.atan(cameras.width / 2 / value)) for value in (focal, focal * ratio))
    size = f"{ratio:.3g} times too small" if ratio > 1 else f"{1 / ratio:.3g} times too large"
    cause = (
        f"the focal length looks {size} (a field of view of {now:.0f}° in the place of about {then:.0f}°): multiply fx "
        f"and fy by {ratio:.3g}"
    )
    return Hypothesis(FOCAL, cause, partial(_with_scaled_focal_length, scale=ratio), ratio in GROSS)


def _finer_focal_lengths(baseline: Score, scored: HypothesisScores, cameras: Cameras) -> list[Hypothesis]:
    """Focal lengths around the best one that was tried, if it explains the data better than any other fault."""
    best, value = min(scored, key=lambda item: item[1].rank)
    if best.name != FOCAL or not value.is_clearly_better_than(baseline):
        return []
    focal = [item for item in scored if item[0].name == FOCAL]
    ratio = RATIOS[[hypothesis for hypothesis, _ in focal].index(best)]
    return [_scaled_focal_length(cameras, ratio * factor) for factor in FINER]


def _with_poses(pair: Observations, change: Callable[[Tensor], Tensor]) -> Observations:
    return replace(pair, cameras=replace(pair.cameras, world_from_camera=change(pair.cameras.world_from_camera)))


def _flip(poses: Tensor) -> Tensor:
    return poses @ torch.diag(poses.new_tensor([1.0, -1.0, -1.0, 1.0]))


def _with_planar_depth(pair: Observations) -> Observations:
    return replace(pair, depth=(pair.depth / camera_rays(pair.cameras).norm(dim=-1)).float())


def _with_scaled_depth(pair: Observations, scale: float) -> Observations:
    return replace(pair, depth=pair.depth * scale)


def _with_scaled_focal_length(pair: Observations, scale: float) -> Observations:
    factors = pair.cameras.intrinsics.new_tensor([[scale, 1.0, 1.0], [1.0, scale, 1.0], [1.0, 1.0, 1.0]])
    return replace(pair, cameras=replace(pair.cameras, intrinsics=pair.cameras.intrinsics * factors))


def _with_principal_point(pair: Observations, place: tuple[float, float]) -> Observations:
    intrinsics = pair.cameras.intrinsics.clone()
    intrinsics[..., :2, 2] = intrinsics.new_tensor(place)
    return replace(pair, cameras=replace(pair.cameras, intrinsics=intrinsics))


def _with_scaled_intrinsics(pair: Observations, x: float, y: float) -> Observations:
    scale = pair.cameras.intrinsics.new_tensor([x, y, 1.0])[:, None]
    return replace(pair, cameras=replace(pair.cameras, intrinsics=pair.cameras.intrinsics * scale))
