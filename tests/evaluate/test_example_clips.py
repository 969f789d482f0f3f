"""The clips that a report shows, and the figures that pick them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.example_clips import first_figures
from persist_cli.evaluate.journal import Journal, Unit
from persist_cli.evaluate.metric_suite import FIGURES, WEIGHTS, MetricSuite
from persist_cli.evaluate.plan import EvalPlan, Evaluation
from persist_cli.evaluate.protocols import PROTOCOLS
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import Setup

PLAN = EvalPlan(
    data=(), protocol="revisit", memories=None, controls=(), metrics=(), frames=0, clips=8, seeds=1,
    sampling=SamplingOverrides(), batch=4, noise=(5.0, 2.0), placement=InferenceOptions(),
)  # fmt: skip

SETUP = Setup(clips=1, frames=3, height=64, width=64, depth=True, generated_depth=True, returns=False)


@pytest.mark.parametrize(("metric", "figure"), [("psnr", 2.0), ("sharpness", 1.5)])
def test_the_figure_of_a_shown_clip_is_that_of_the_table(tmp_path: Path, metric: str, figure: float):
    case = Case("data", "walk", "room", 0, 4, 1, (1.0,) * 4, (-1,) * 4, (False, True, False, True))
    suite, journal = MetricSuite({metric: METRICS[metric]}, SETUP), Journal(tmp_path)
    figures = torch.tensor([[9.0, 1.0, 9.0, 3.0]], dtype=torch.float64)[..., None]
    weights = torch.tensor([[1.0, 3.0, 1.0, 1.0]], dtype=torch.float64)  # a frame counts by its detail
    journal.folder.mkdir()
    journal.write(Unit(0, 0, 0), {FIGURES: figures, WEIGHTS + "sharpness": weights})
    run = Evaluation(
        plan=PLAN, sampling=Sampling(), checkpoints=[], protocol=PROTOCOLS["revisit"], cases=[case], rows=[],
        missing=[], suites=[suite], journal=journal,
    )  # fmt: skip
    assert first_figures(run, 0).tolist() == [figure]
