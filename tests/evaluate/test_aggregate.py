"""Tables over some of the clips: which are drawn together, and what cannot be measured of them alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from persist_cli.api.backbone import Sampling
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.evaluate.aggregate import RowResults, Table
from persist_cli.evaluate.journal import Journal
from persist_cli.evaluate.metric_suite import MetricSuite, choose_metrics, make_setup
from persist_cli.evaluate.plan import EvalPlan, Evaluation
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.metrics import METRICS

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


def table_of(cases, clips, resample="scenes"):
    """A table over some clips of an evaluation by PSNR and FVD."""
    suite = MetricSuite(choose_metrics(("psnr", "fvd"), METRICS), make_setup(cases))
    plan, journal = replace(PLAN, resample=resample), Journal(Path("unused"))
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
