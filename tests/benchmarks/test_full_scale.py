"""The benchmark at full scale runs from end to end, and compares models that compute the same."""

from __future__ import annotations

import json

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from tests.benchmarks import bench_full_scale
from tests.benchmarks.full_scale import measuring, sampling, shapes
from tests.benchmarks.full_scale.measuring import Timing, Turns
from tests.benchmarks.full_scale.plain import Plain
from tests.benchmarks.full_scale.rows import Row, Target
from tests.benchmarks.full_scale.sampling import Scene
from tests.benchmarks.full_scale.training import make_batch, plain_batch, stage1_steps
from tests.support import resident_memory
from tests.support.micro_runs import MICRO


@pytest.fixture
def micro(monkeypatch):
    """A model so small that all parts take seconds, and one that is measured as those of published size are."""
    monkeypatch.setattr(sampling, "STEPS", (10,))
    monkeypatch.setattr(sampling, "CONTEXT", 2)
    monkeypatch.setitem(sampling.DINO, "num_hidden_layers", 1)
    monkeypatch.setitem(measuring.SIDES, "cpu", 128)
    adapter = {"form": "cross", "every": 2, "width": 16}
    monkeypatch.setitem(shapes.MODELS, "micro", shapes.Model("micro", MICRO, adapter, 2, 8))
    monkeypatch.setitem(shapes.MODELS, "5b", shapes.Model("5b", MICRO, adapter, 2, 384, published=True))
    return shapes.MODELS["micro"]


def measured_rows(folder, *options):
    """The rows that the benchmark writes for the CPU."""
    bench_full_scale.main(["--quick", *options, "--device", "cpu", "--json", str(folder / "rows.json")])
    return json.loads((folder / "rows.json").read_text())["rows"]


@pytest.mark.usefixtures("fresh_accelerator")
@pytest.mark.parametrize(("name", "precision"), [("micro", "float32"), ("5b", "bfloat16")])
def test_every_part_of_the_benchmark_runs_on_the_cpu(name, precision, micro, tmp_path, capsys):
    rows = measured_rows(tmp_path, "--models", name, "--precision", precision)
    assert [row["what"].split(",")[0] for row in rows] == [
        "stage-1 step", "stage-2 step", "clip", "clip with voxel map", "VAE", "VAE", "map", "map",
    ]  # fmt: skip
    assert all(0 < row["utilisation"] < 1 for row in rows[:4])
    assert all(row["ratio"] > 0 for row in rows if row["beside"])
    targets = [target["text"] for row in rows for target in row["targets"]]
    assert targets == (["no slower than plain", "utilisation ≥ 45%", "≤ 1 s", "≤ 10 % more"] if name == "5b" else [])
    assert "stage-1" in capsys.readouterr().out


@pytest.mark.usefixtures("fresh_accelerator", "micro")
def test_a_model_of_published_size_takes_its_steps_in_mixed_precision(tmp_path):
    rows = measured_rows(tmp_path, "--models", "5b", "--precision", "mixed", "--only", "steps")
    assert [row["what"].split(",")[0] for row in rows] == ["stage-1 step", "stage-2 step"]
    assert all(0 < row["utilisation"] < 1 for row in rows)
    assert all(row["ratio"] > 0 for row in rows if row["beside"])
    targets = [target["text"] for row in rows for target in row["targets"]]
    assert targets == ["no slower than plain", "utilisation ≥ 45%"]


def test_the_plain_model_with_our_weights_predicts_what_ours_does(micro):
    bench = shapes.Bench(micro, torch.device("cpu"), torch.float32, 1, 1.0)
    ours, plain = bench.backbone, Plain(bench)
    ours.use_adapter(None)
    theirs, base = plain.transformer, ours.transformer.base
    weights = base.state_dict()
    known, extra = base.patch_embed.proj.weight, ours.transformer.extra_in.weight
    with torch.no_grad():
        extra.normal_(std=0.1)
        weights["patch_embed.proj.weight"] = torch.cat([known, extra], dim=1)
        weights["proj_out.weight"] = theirs.proj_out.weight
        weights["proj_out.bias"] = theirs.proj_out.bias.zero_()
    theirs.load_state_dict(weights)
    seen: list[torch.Tensor] = []
    base.norm_out.register_forward_hook(lambda *parts: seen.append(parts[2]))
    theirs.norm_out.register_forward_hook(lambda *parts: seen.append(parts[2]))
    clips = make_batch(bench, 2, 0)
    latents, image, camera = plain_batch(bench, clips)
    timesteps = torch.tensor([10, 800])
    with torch.no_grad():
        ours.predict(latents, image, ours.conditions(clips, timesteps))
        color, depth = latents.chunk(2, dim=2)
        color_image, depth_image = image.chunk(2, dim=2)
        joined = torch.cat([color, color_image, depth, depth_image, camera], dim=2)
        plain.predict(joined, timesteps, plain.rotary(latents))
    assert torch.allclose(seen[0], seen[1][:, -seen[0].shape[1] :], atol=1e-5)


def counted(function):
    """FLOPs of a function, backward included, by torch."""
    with FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops()


def test_our_step_clip_and_codec_take_as_many_flops_as_the_plain_ones(micro, tmp_path):
    """Up to a thousandth, which the embedding of cameras takes."""
    bench = shapes.Bench(micro, torch.device("cpu"), torch.float32, 1, 1.0)
    steps = {name: counted(function) for name, function in stage1_steps(bench, 2).items()}
    assert steps["ours"] == pytest.approx(steps["plain"], rel=1e-3)
    bench.backbone.requires_grad_(False)
    plain = Plain(bench)
    clips = {
        name: counted(function) for name, function in sampling.clip_functions(Scene(bench, tmp_path), plain, 3).items()
    }
    assert clips["alone"] == pytest.approx(clips["plain"], rel=1e-3)
    assert clips["memory"] > clips["alone"]
    seen, images = bench.clips(1, bench.size[0]), sampling.plain_images(bench)
    codec, latents = bench.backbone.codec, plain.encode(images)
    assert counted(lambda: codec.encode(seen.rgb, seen.depth)) == counted(lambda: plain.encode(images))
    assert counted(lambda: sampling.decode(codec, latents)) == counted(lambda: plain.decode(latents))


def test_an_unknown_model_or_part_is_a_usage_error(capsys):
    for option, name in (("--models", "7b"), ("--only", "step")):
        with pytest.raises(SystemExit) as ended:
            bench_full_scale.main([option, name])
        assert ended.value.code == 2
        assert name in capsys.readouterr().err


def test_targets_are_reached_not_reached_or_not_measured():
    assert Target("≤ 1 s", 0.9, 1.0).reached
    assert not Target("≥ 45 %", 0.4, 0.45, at_most=False).reached
    assert Target("≤ 1 s", None, 1.0).cell() == "≤ 1 s: not measured"


def test_the_row_of_a_function_that_does_not_fit_says_so():
    row = Row("5b", "clip", None, "plain diffusers", Timing((2.0, 1.0, 3.0), 10**9))
    assert row.ratio is None
    assert {"does not fit", "plain diffusers", "2 (1)", "1.00"} <= set(row.cells())


@pytest.mark.skipif(not resident_memory.KNOWN, reason="peak memory is asked of Linux")
def test_the_peak_is_that_of_the_largest_run_and_a_function_that_does_not_fit_has_no_timing():
    numbers = iter([1, 30_000_000, 1])  # floats of the run that does not count, and of two that do

    def tight():
        raise torch.OutOfMemoryError

    functions = {"little": lambda: None, "tight": tight, "much": lambda: torch.ones(next(numbers))}
    timings = Turns(torch.device("cpu"), 2).measure(functions)
    assert timings["tight"] is None
    assert timings["much"].peak - timings["little"].peak == pytest.approx(120e6, rel=0.1)
    assert len(timings["much"].seconds) == 2
