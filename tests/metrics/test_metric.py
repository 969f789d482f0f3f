"""Names, definitions and obstacles of all metrics, and the checks of a prediction."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from persist_cli.errors import DataError
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import FrameMetric, FrameSetMetric, SetMetric
from persist_cli.rollout.outputs import compare
from tests.support.predictions import prediction, random_frames, setup, still_camera, there_and_back


def test_every_metric_has_a_name_a_title_and_a_definition_of_one_line():
    columns = (
        "psnr sharpness grain ssim lpips-alex lpips-vgg dreamsim fvd kd-dinov2 src src-patch src-away psnr-own "
        "lpips-own absrel rmse delta1 drift rot-error trans-error"
    )
    assert " ".join(METRICS) == columns
    for name, metric in METRICS.items():
        assert metric.name == name
        assert metric.better in ("higher", "lower") or name in ("sharpness", "grain", "src-away")
        assert isinstance(metric, FrameMetric | FrameSetMetric | SetMetric)
        assert metric.title
        assert len(metric.definition) > 20
        assert "\n" not in metric.definition


def test_metrics_without_their_weights_name_the_command_that_fetches_them(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    for name, metric in METRICS.items():
        obstacle = metric.obstacle(setup(unseen_scenes=2))
        assert bool(obstacle) == bool(metric.weights), name
        assert obstacle is None or f"persist weights fetch {metric.weights[0]}" in obstacle


CAMERA = ("rot-error", "trans-error")


def test_importing_the_metrics_imports_no_network_and_no_heavy_library():
    heavy = ("transformers", "torchmetrics", "scipy", "diffusers", "persist_memory", "persist_cli.plugins")
    code = f"import sys, persist_cli.metrics; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "[]\n"


def test_a_video_that_does_not_match_the_truth_is_one_line():
    rgb, depth = random_frames(0)
    whole = prediction(rgb, depth, still_camera(rgb, depth))
    whole.check("clip 3")
    hole = depth.clone()
    hole[1, 2, 3] = float("nan")
    for changes, cause in (
        ({"rgb": rgb[:, :16]}, r"generated RGB \[2, 16, 32, 3\] .* true RGB \[2, 32, 32, 3\]"),
        ({"rgb": rgb[:1], "depth": depth[:1]}, r"generated RGB \[1, 32, 32, 3\]"),
        ({"depth": depth[:, :, :8]}, r"depth \[2, 32, 8\], true"),
        ({"rgb": rgb / 255}, "generated RGB is torch.float32, wanted uint8"),
        ({"depth": hole}, "generated depth is not finite"),
        ({"depth": depth / 0}, "generated depth is not finite"),
        ({"first_visits": torch.tensor([-1])}, "for each of 2"),
        ({"first_visits": torch.tensor([-1, 1])}, "must name an earlier frame"),
    ):
        with pytest.raises(DataError, match=f"^clip 3: .*{cause}") as error:
            replace(whole, **changes).check("clip 3")
        assert "\n" not in str(error.value)


def test_a_rollout_is_compared_by_the_frame_metrics_that_can_be_measured(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    start, truth = there_and_back().truth[:1], there_and_back().truth[1:]
    figures = compare(start, replace(truth, depth=truth.depth * 1.1), truth)
    assert list(figures) == ["psnr", "sharpness", "grain", "ssim", "absrel", "rmse", "delta1", "drift", *CAMERA]
    assert figures["psnr"] == [100.0] * 6
    assert figures["absrel"] == pytest.approx([0.1] * 6, rel=1e-5)
    assert "drift" not in compare(start, truth, replace(truth, depth=torch.zeros_like(truth.depth)))
    assert list(compare(start, truth, truth, gives_depth=False)) == ["psnr", "sharpness", "grain", "ssim"]


def test_a_single_imagined_frame_is_compared_as_well(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    truth = there_and_back().truth
    figures = compare(truth[:1], truth[1:2], truth[1:2])
    assert {name: figures[name] for name in ("psnr", "absrel", "delta1")} == {
        "psnr": [100.0], "absrel": [0.0], "delta1": [1.0],
    }  # fmt: skip
