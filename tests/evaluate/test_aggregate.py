"""Tables over some of the clips: which are drawn together, and what cannot be measured of them alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.evaluate.aggregate import RowResults, Table
from persist_cli.evaluate.journal import TRUTH, Journal, Unit
from persist_cli.evaluate.metric_suite import FEATURES, MetricSuite, choose_metrics, make_setup
from persist_cli.evaluate.plan import EvalPlan, Evaluation
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.metrics import METRICS
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
