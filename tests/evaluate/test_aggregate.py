"""Tables over some of the clips: which are drawn together, and what cannot be measured of them alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.evaluate.aggregate import RowResults, Table
from persist_cli.evaluate.journal import TRUTH, Journal, Unit
from persist_cli.evaluate.metric_suite import (
    CELLS,
    FEATURES,
    FIGURES,
    READS,
    WEIGHTS,
    MetricSuite,
    choose_metrics,
    make_setup,
)
from persist_cli.evaluate.plan import EvalPlan, Evaluation
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.evaluate.statistics import Draws
from persist_cli.metrics import METRICS
from persist_cli.metrics.kernel_distance import KernelDistance
from persist_cli.metrics.metric import SetMetric

PLAN = EvalPlan(
    data=(), protocol="revisit", memories=None, controls=(), metrics=(), frames=0, clips=8, seeds=1,
    sampling=SamplingOverrides(), batch=4, noise=(5.0, 2.0), placement=InferenceOptions(),
)  # fmt: skip


@pytest.fixture(scope="module")
def cases(held_out):
    """Six clips of 17 frames of two scenes, as if the first scene were in two data sets."""
    one, two = PROTOCOLS["revisit"].find(ClipSearch(folders=[held_out], frames=0, limit=8, predicted_at_once=8))
    several = [replace(one, data=f"{one.data}/"), two, one, one, two, one]
    whole = {"frames": 17, "seen_before": (1.0,) * 17, "first_visits": (-1,) * 17, "counted": (True,) * 17}
    return [replace(case, **whole) for case in several]


class Means(SetMetric):
    """A distance between sets of videos that needs no weights."""

    name, title, better, definition = "fvd", "FVD", "lower", "difference of the mean features"

    def obstacle(self, setup):
        """The reason when there are fewer than three videos."""
        return None if setup.clips > 2 else f"{setup.clips} of three"

    def features(self, rgb):
        """Not asked for: the journal has them."""
        raise AssertionError

    def distance(self, features, true_features):
        """The difference of the means."""
        return float(features.mean() - true_features.mean())


class Measured(RowResults):
    """A row whose only videos have their number as their feature."""

    models, seeds = ("",), range(1)

    def gather(self, name):
        """Features ``[model, seed, clip, channel]``."""
        return torch.arange(6.0).reshape(1, 1, 6, 1)


def table_of(cases, clips, resample="scenes", metrics=choose_metrics(("psnr", "fvd"), METRICS), out=Path("unused")):
    """A table over some clips of an evaluation by PSNR and FVD."""
    suite = MetricSuite(metrics, make_setup(cases))
    plan, journal = replace(PLAN, resample=resample), Journal(out)
    run = Evaluation(
        plan=plan, sampling=Sampling(), checkpoints=[], protocol=PROTOCOLS["revisit"], cases=cases, rows=[], missing=[],
        suites=[suite], journal=journal,
    )  # fmt: skip
    return Table(run, "all", clips)


def test_clips_of_one_scene_are_drawn_together_from_whichever_data_set_they_come(cases):
    table = table_of(cases, range(6))
    assert table.clusters.tolist() == [0, 1, 0, 0, 1, 0]
    assert table.scenes == 2
    assert table_of(cases, range(6), "clips").clusters.tolist() == [0, 1, 2, 3, 4, 5]


def test_a_table_of_few_clips_has_no_fvd_although_all_clips_would_be_enough(cases):
    table = table_of(cases, [0, 1, 2])
    results = RowResults(table.run, [0])
    assert table.obstacles(results) == {"fvd": "3 clips, FVD needs 5"}
    assert "clips" not in table_of(cases, range(6)).obstacles(results).get("fvd", "")


def test_a_distance_where_all_was_seen_takes_the_clips_seen_in_every_predicted_view(cases, tmp_path):
    half = [
        replace(case, seen_before=(0.0, *(1.0,) * 15, last)) for case, last in zip(cases, [0.9, 0.8] * 3, strict=True)
    ]
    table = table_of(half, range(6), metrics={"fvd": Means()}, out=tmp_path)
    tmp_path.joinpath(table.run.journal.folder).mkdir()
    for batch, clips in enumerate((4, 2)):
        table.run.journal.write(Unit(TRUTH, 0, batch), {FEATURES + "fvd": torch.zeros(clips, 1)})
    whole, seen = table.columns
    assert (whole.name, seen.name, seen.title) == ("fvd", "fvd-seen", "FVD where seen")
    assert seen.definition == "as FVD, of the clips only of whose every predicted view at least 90% was seen before"
    figures = table.figures(Measured(table.run, [0]))
    assert (figures["fvd"].mean, figures["fvd"].count) == (2.5, 6)
    assert (figures["fvd-seen"].mean, figures["fvd-seen"].count) == (2.0, 3)  # clips 0, 2 and 4
    few = table_of(half, [0, 1, 2], metrics={"fvd": Means()}, out=tmp_path)
    results = Measured(few.run, [0])
    assert [few.obstacle(column, results) for column in few.columns] == [None, "2 of three"]
    assert few.cell(few.columns[1], results, {"": few.figures(results)}) == {"na": "2 of three"}


class Kept(RowResults):
    """A row of one model and seed with these tensors of all clips in place of a journal."""

    models, seeds = ("",), range(1)
    row = SimpleNamespace(memory_json=lambda info: {"resolution": 0.25})

    def __init__(self, run, tensors):
        super().__init__(run, [0])
        self.__dict__["tensors"] = tensors

    def gather(self, name):
        """The tensor ``[model, seed, clip, ...]``."""
        return self.tensors[name][None, None]

    def measured(self, name):
        """Whether it is among the tensors."""
        return name in self.tensors


def drawn_figures(*metrics):
    """Tensors of six clips of 17 frames: random figures of some metrics, and random weights of sharpness and grain."""
    draw = torch.Generator().manual_seed(0)
    figures = torch.rand(6, 17, len(metrics), generator=draw, dtype=torch.float64)
    sharpness, grain = torch.rand(2, 6, 17, generator=draw, dtype=torch.float64)
    return {FIGURES: figures, WEIGHTS + "sharpness": sharpness, WEIGHTS + "grain": grain}


def test_a_figure_is_of_the_clips_of_its_table_and_of_their_frames_that_count_each_by_its_weight(cases):
    counted = [replace(case, counted=(False, *(n > clip for n in range(16)))) for clip, case in enumerate(cases)]
    table = table_of(counted, [1, 3, 4], metrics=choose_metrics(("psnr", "sharpness"), METRICS))
    names = list(table.run.suites[0].frame_metrics)
    tensors = drawn_figures(*names)
    figures = table.figures(Kept(table.run, tensors))
    psnr, sharp = (tensors[FIGURES][..., names.index(name)] for name in ("psnr", "sharpness"))
    firsts = {clip: clip + 2 for clip in (1, 3, 4)}
    means = [float(psnr[clip, first:].mean()) for clip, first in firsts.items()]
    assert figures["psnr"].per_clip == pytest.approx(means)
    assert figures["psnr"].mean == pytest.approx(sum(means) / 3)
    assert figures["psnr"].clip_weights is None
    weights = tensors[WEIGHTS + "sharpness"]
    sums = [
        float(sum((part[clip, first:] * weights[clip, first:]).sum() for clip, first in firsts.items()))
        for part in (sharp, torch.ones_like(sharp))
    ]
    assert figures["sharpness"].mean == pytest.approx(sums[0] / sums[1])


def test_a_figure_of_returns_is_of_those_over_more_frames_than_are_predicted_at_once(cases):
    visits = tuple(0 if frame in (4, 12) else -1 for frame in range(17))
    metrics = choose_metrics(("psnr",), METRICS)
    returning = [replace(case, first_visits=visits) for case in cases]
    suites = [MetricSuite(metrics, make_setup(returning, True, 8))]
    run = replace(table_of(returning, [], metrics=metrics).run, protocol=PROTOCOLS["return"], suites=suites)
    tensors = drawn_figures("psnr")
    figures = Table(run, "all", range(6)).figures(Kept(run, tensors))
    assert figures["psnr-return"].per_clip == pytest.approx(tensors[FIGURES][:, 12, 0].numpy())


def test_a_curve_bins_each_frame_by_the_share_of_its_own_view_and_counts_it_by_its_weight(cases):
    shares = (1.0, *(0.05,) * 15, 0.95)
    shown = [replace(case, seen_before=shares) for case in cases]
    table = table_of(shown, range(6), metrics=choose_metrics(("sharpness",), METRICS))
    names = list(table.run.suites[0].frame_metrics)
    tensors = drawn_figures(*names)
    low, high = table.curves(Kept(table.run, tensors))["sharpness"]["by_seen_before"]
    values, weights = tensors[FIGURES][..., names.index("sharpness")], tensors[WEIGHTS + "sharpness"]
    for one, frames, count in ((low, slice(1, 16), 90), (high, slice(16, 17), 6)):
        assert one["count"] == count
        mean = (values * weights)[:, frames].sum() / weights[:, frames].sum()
        assert one["mean"] == pytest.approx(float(mean))


def test_what_was_read_and_how_maps_grow_is_told_of_the_clips_of_a_table(cases):
    tokens, cells = torch.arange(12.0).reshape(6, 2), torch.arange(12).reshape(6, 2)
    table = table_of(cases, [3, 5], metrics=choose_metrics(("psnr",), METRICS))
    results = Kept(table.run, drawn_figures("psnr") | {READS: tokens, CELLS: cells})
    assert table.reads(results) == {"resolution": 0.25, "tokens": 8.0, "bytes": 9.0}
    windows = table.windows(results)
    assert windows[CELLS] == [8.0, 9.0]
    assert len(windows["psnr"]) == 2
    assert windows["psnr"][0] == pytest.approx(float(results.tensors[FIGURES][[3, 5], 1:9].mean()))


class Trained(Kept):
    """A row of three trainings."""

    models = ("a", "b", "c")


def test_a_row_of_several_trainings_draws_its_own(cases):
    table = table_of(cases, range(6))
    draws = table.draws(Trained(table.run, {}), 20)
    assert draws.models.tolist() == Draws.of(table.clusters, ("a", "b", "c"), 20).models.tolist()


class AnyKernelDistance(KernelDistance):
    """The kernel distance of given features, which needs no weights."""

    def obstacle(self, setup):
        """Nothing."""
        return None


def test_frames_of_one_scene_are_no_pairs_whether_scenes_or_clips_are_drawn(cases, tmp_path):
    draw = torch.Generator().manual_seed(0)
    generated, true = torch.randn(2, 6, 17, 4, generator=draw, dtype=torch.float64)
    true[0] = torch.nan  # of the first clip of its scene no frame is taken
    true[:, :9] = torch.nan
    figures = []
    for resample in ("scenes", "clips"):
        table = table_of(cases, range(6), resample, {"kd-dinov2": AnyKernelDistance()}, tmp_path / resample)
        table.run.journal.folder.mkdir(parents=True)
        for batch, part in enumerate(true.split(4)):
            table.run.journal.write(Unit(TRUTH, 0, batch), {FEATURES + "kd-dinov2": part})
        figures.append(table.figures(Kept(table.run, {FEATURES + "kd-dinov2": generated}))["kd-dinov2"])
    scenes = torch.tensor([0, 1, 0, 0, 1, 0])[1:].repeat_interleave(8)
    sums, pairs = AnyKernelDistance().scene_sums(generated[1:, 9:].flatten(0, 1), true[1:, 9:].flatten(0, 1), scenes)
    assert figures[0].mean == pytest.approx(float(sums.sum() / pairs.sum()))
    assert figures[1].mean == pytest.approx(figures[0].mean)
    assert [figure.count for figure in figures] == [5, 5]


def test_a_distance_of_some_clips_compares_each_with_its_own_truth(cases, tmp_path):
    table = table_of(cases, [1, 3, 4, 5], metrics={"fvd": Means()}, out=tmp_path)
    table.run.journal.folder.mkdir()
    for batch, part in enumerate(torch.arange(6.0)[:, None].square().split(4)):
        table.run.journal.write(Unit(TRUTH, 0, batch), {FEATURES + "fvd": part})
    assert table.figures(Measured(table.run, [0]))["fvd"].mean == 13 / 4 - (1 + 9 + 16 + 25) / 4


class Lengths(Means):
    """Features that tell how long a video is and how bright."""

    def features(self, rgb):
        """Number of frames and their greatest value."""
        return torch.tensor([float(len(rgb)), float(rgb.max())])


def test_the_given_first_frame_is_in_no_features(cases):
    suite = MetricSuite({"fvd": Lengths()}, make_setup(cases))
    rgb = torch.zeros(6, 17, 2, 2, 3, dtype=torch.uint8)
    rgb[:, 0] = 255
    assert suite.features(rgb, cases)[FEATURES + "fvd"].tolist() == [[16.0, 0.0]] * 6
