import json

import pytest
import torch

from persist_cli.evaluation.revisits import find_revisits, recalled_part
from persist_cli.metrics import METRICS
from persist_cli.trajectories.store import Store
from persist_cli.world.errors import DataError
from tests.rooms import Room
from tests.walking import smoothed


def images(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    return (
        torch.randint(0, 256, (2, 32, 32, 3), generator=draw, dtype=torch.uint8),
        torch.rand(2, 32, 32, generator=draw) + 1,
    )


def test_metrics_of_the_truth_itself_are_perfect():
    rgb, depth = images(0)
    assert METRICS["psnr"].measure(rgb, depth, rgb, depth).tolist() == [100.0, 100.0]
    assert METRICS["ssim"].measure(rgb, depth, rgb, depth).tolist() == pytest.approx([1.0, 1.0])
    assert METRICS["absrel"].measure(rgb, depth, rgb, depth).tolist() == [0.0, 0.0]


def test_psnr_and_absrel_follow_their_definitions():
    (rgb, depth), (other, _) = images(0), images(1)
    error = ((rgb.double() - other.double()) ** 2).mean((1, 2, 3))
    expected = 10 * torch.log10(255.0**2 / error)
    assert torch.allclose(METRICS["psnr"].measure(other, depth, rgb, depth), expected, atol=1e-6)
    assert METRICS["absrel"].measure(rgb, depth * 1.1, rgb, depth).tolist() == pytest.approx([0.1, 0.1], rel=1e-5)


def test_missing_true_depth_is_left_out_and_missing_generated_depth_is_an_error():
    rgb, depth = images(0)
    holes = depth.clone()
    holes[:, :16] = 0
    assert METRICS["absrel"].measure(rgb, depth, rgb, holes).tolist() == [0.0, 0.0]
    assert METRICS["absrel"].measure(rgb, holes, rgb, depth).tolist() == pytest.approx([0.5, 0.5])
    assert METRICS["absrel"].measure(rgb, depth, rgb, torch.zeros_like(depth)).isnan().all()


def test_the_way_back_recalls_what_the_way_out_saw(walks):
    revisits = find_revisits(Store(walks), 9, 8)
    assert all(each.start >= 9 for each in revisits)
    assert max(each.recalled for each in revisits) > 0.5
    seen = Store(walks)[0].read().observations
    assert recalled_part(seen, 9, 9) == 0


def test_a_path_that_never_returns_has_no_clip_to_evaluate(tmp_path):
    Room(32, 32).write(tmp_path / "a.parquet", smoothed(24))
    with pytest.raises(DataError, match="no clip returns"):
        find_revisits(Store(tmp_path), 9, 8)


def test_eval_prints_a_table_and_leaves_figures_and_sheets(persist, voxel, stage1, walks, tmp_path):
    options = ["--data", walks, "--memories", "stage1,voxel", "--seeds", 2, "--steps", 2, "--out", tmp_path]
    ended = persist("eval", voxel, *options)
    assert ended.code == 0, ended.err
    for word in ("PSNR", "SSIM", "AbsRel", "voxel", "copy of the first frame", "codec reconstruction", "±"):
        assert word in ended.out
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert set(report["rows"]) == {"stage1", "voxel", "copy of the first frame", "codec reconstruction"}
    assert len(report["rows"]["voxel"]["psnr"]["per_frame"]) == 8
    assert report["rows"]["voxel"]["psnr"]["std"] > 0
    assert report["rows"]["codec reconstruction"]["psnr"]["std"] == 0
    assert (tmp_path / "clip-0.png").is_file()


def test_eval_is_the_same_again_and_does_not_depend_on_the_batch(persist, voxel, walks, tmp_path):
    rows = []
    for name, batch in (("a", 2), ("b", 2), ("c", 1)):
        options = ["--memories", "voxel", "--seeds", 1, "--steps", 2, "--clips", 2, "--batch", batch]
        assert persist("eval", voxel, "--data", walks, *options, "--out", tmp_path / name).code == 0
        rows.append(json.loads((tmp_path / name / "metrics.json").read_text())["rows"]["voxel"]["psnr"]["per_clip"])
    assert rows[0] == rows[1]
    assert rows[0] == pytest.approx(rows[2], abs=0.05)


def test_what_cannot_be_evaluated_is_one_line(persist, voxel, walks, tmp_path):
    for options, cause in (
        (
            ["--data", walks, "--memories", "snapshots"],
            "no checkpoint has a memory adapter 'snapshots'; there are: voxel",
        ),
        (["--data", tmp_path, "--memories", "voxel"], "no trajectory"),
        (["--data", walks, "--memories", ","], "name at least one memory"),
        (["--data", walks, "--memories", "voxel", "--sampler", "euler"], "unknown sampler 'euler'"),
    ):
        ended = persist("eval", voxel, *options, "--out", tmp_path / "o")
        assert (ended.code, cause in ended.err) == (1, True), ended.err
    assert not (tmp_path / "o").exists()
