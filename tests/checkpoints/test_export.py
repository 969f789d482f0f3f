"""Exports stand alone, generate what the runs do, and refuse what does not fit together."""

from __future__ import annotations

import hashlib
import json

import pytest
import torch
import yaml

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.inference import PROTOCOLS as PROTOCOL_NAMES
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.stages import Lora
from persist_cli.checkpoints.exported_files import without_absolute_paths
from persist_cli.checkpoints.load import load_adapter, load_backbone
from persist_cli.checkpoints.save import save_base, save_lora
from persist_cli.errors import CheckpointError
from persist_cli.evaluate.protocols import PROTOCOLS
from persist_cli.io.files import load_exactly, read_tensors, write_tensors
from tests.support.damage import without_sums
from tests.support.disk import file_limit
from tests.support.export_runs import write_adapter, write_base, write_runs
from tests.support.micro_model import random_clips, random_tokens
from tests.support.micro_runs import stage


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return write_runs(tmp_path_factory.mktemp("exporting"))


@pytest.fixture
def export(persist, runs):
    """``persist export`` of the stage-1 run."""

    def run(out, *arguments):
        ended = persist("export", runs / "stage1", *arguments, "--out", out)
        assert ended.code == 0, ended.err
        return ended.out

    return run


def generated(path, adapter, original=None):
    """A clip that the checkpoint's base and one of its adapters generate from memory tokens."""
    checkpoint = find_checkpoint(path)
    backbone = load_backbone(checkpoint).eval()
    load_adapter(backbone, checkpoint, adapter)
    return backbone.generate(random_clips(1, random_tokens(1, 5)), Sampling(2))


def test_a_float32_export_generates_bit_for_bit_what_the_runs_do(export, runs, tmp_path):
    export(tmp_path / "m", runs / "voxel", f"fine={runs / 'canvas'}", "--dtype", "float32")
    for run, adapter, name in (("stage1", None, None), ("voxel", "voxel", "voxel"), ("canvas", "voxel", "fine")):
        of_run, of_export = generated(runs / run, adapter), generated(tmp_path / "m", name)
        for expected, actual in zip(of_run, of_export, strict=True):
            assert torch.equal(expected, actual)
    rgb = [generated(tmp_path / "m", name)[0] for name in (None, "voxel", "fine")]
    assert not torch.equal(rgb[0], rgb[1])
    assert not torch.equal(rgb[1], rgb[2])


@pytest.mark.parametrize(("dtype", "kind"), [("float16", torch.float16), ("bfloat16", torch.bfloat16)])
def test_exported_weights_are_the_originals_rounded_to_the_requested_precision(export, runs, tmp_path, dtype, kind):
    export(tmp_path / "m", runs / "voxel", "--dtype", dtype)
    files = list((tmp_path / "m").rglob("*.safetensors"))
    assert len(files) == 4
    for path in files:
        owner = runs / ("voxel" if "adapters" in path.parts else "stage1")
        original, metadata = read_tensors(owner / path.relative_to(tmp_path / "m"))
        exported, exported_metadata = read_tensors(path)
        assert metadata == exported_metadata
        assert exported.keys() == original.keys()
        assert all(torch.equal(exported[name], original[name].to(kind)) for name in original)


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_files_in_half_precision_are_loaded_as_float32_parameters(export, runs, tmp_path, dtype):
    export(tmp_path / "m", runs / "voxel", "--dtype", dtype)
    checkpoint = find_checkpoint(tmp_path / "m")
    backbone = load_backbone(checkpoint)
    load_adapter(backbone, checkpoint, "voxel")
    assert {value.dtype for value in backbone.state_dict().values() if value.is_floating_point()} == {torch.float32}
    expected, _ = read_tensors(runs / "stage1/world.safetensors")
    assert torch.allclose(backbone.prompt, expected["prompt"], atol=1e-2)


def test_tensors_loaded_into_a_module_on_the_meta_device_take_its_precision(tmp_path):
    with torch.device("meta"):
        module = torch.nn.Linear(2, 2)
    tensors = {"weight": torch.ones(2, 2).half(), "bias": torch.ones(2).bfloat16()}
    load_exactly(module, tensors, {"weight", "bias"}, tmp_path)
    assert (module.weight.dtype, module.bias.dtype) == (torch.float32, torch.float32)
    assert module(torch.ones(1, 2)).tolist() == [[3, 3]]


def test_an_export_of_an_export_has_the_same_files(export, persist, runs, tmp_path):
    export(tmp_path / "m", runs / "none", runs / "voxel", "--default", "voxel")
    assert persist("export", tmp_path / "m", "--out", tmp_path / "again").code == 0
    assert (tmp_path / "m/SHA256SUMS").read_bytes() == (tmp_path / "again/SHA256SUMS").read_bytes()
    assert find_checkpoint(tmp_path / "again").default_adapter() == "voxel"


def test_exporting_a_stage_2_run_exports_its_base_and_adapter(persist, export, runs, tmp_path):
    assert persist("export", runs / "voxel", "--out", tmp_path / "a").code == 0
    export(tmp_path / "b", runs / "voxel")
    assert (tmp_path / "a/SHA256SUMS").read_bytes() == (tmp_path / "b/SHA256SUMS").read_bytes()


def test_the_exported_sampling_is_the_default_of_the_checkpoint(export, runs, tmp_path):
    export(tmp_path / "m", "--steps", "7", "--sampler", "unipc", "--guidance", "1.5")
    exported, run = find_checkpoint(tmp_path / "m"), find_checkpoint(runs / "stage1")
    assert exported.sampling_with(SamplingOverrides()) == Sampling(7, "unipc", 1.5)
    assert exported.sampling_with(SamplingOverrides(3, "ddim")) == Sampling(3, "ddim", 1.5)
    assert exported.sampling_with(SamplingOverrides(memory_guidance=1.0)) == Sampling(7, "unipc", 1.0)
    assert (run.sampling, run.sampling_with(SamplingOverrides())) == (None, Sampling(50, "ddim", 1.0))


def test_a_protocol_may_have_a_sampling_of_its_own_which_options_still_override(persist, export, runs, tmp_path):
    export(tmp_path / "m", "--steps", "4", "--sampling-for", "return:steps=20,guidance=1.5")
    card = find_checkpoint(tmp_path / "m")
    assert card.sampling_with(SamplingOverrides(), "return") == Sampling(20, "ddim", 1.5)
    assert card.sampling_with(SamplingOverrides(), "revisit") == Sampling(4, "ddim", 1.0)
    assert card.sampling_with(SamplingOverrides(steps=2), "return") == Sampling(2, "ddim", 1.5)
    assert persist("export", tmp_path / "m", "--steps", 5, "--out", tmp_path / "again").code == 0
    assert find_checkpoint(tmp_path / "again").sampling_with(SamplingOverrides(), "return") == Sampling(20, "ddim", 1.5)


@pytest.mark.parametrize(("sampler", "kept"), [("unipc", Sampling(4, "unipc")), ("consistency", None)])
def test_a_model_trained_on_is_sampled_as_its_base_unless_that_is_distilled(export, tmp_path, sampler, kept):
    export(tmp_path / "m", "--steps", "4", "--sampler", sampler, "--sampling-for", "return:steps=20")
    base = find_checkpoint(tmp_path / "m")
    (tmp_path / "on").mkdir()
    save_base(load_backbone(base), tmp_path / "on", base=base)
    trained = find_checkpoint(tmp_path / "on")
    assert trained.sampling == kept
    expected = Sampling(20, "unipc") if kept else Sampling(50, "ddim")
    assert trained.sampling_with(SamplingOverrides(), "return") == expected


def test_a_model_trained_on_keeps_the_sampling_of_a_protocol_where_its_base_has_no_other(export, tmp_path):
    export(tmp_path / "m", "--sampling-for", "return:steps=20")
    base = find_checkpoint(tmp_path / "m")
    (tmp_path / "on").mkdir()
    save_base(load_backbone(base), tmp_path / "on", base=base)
    trained = find_checkpoint(tmp_path / "on")
    assert (trained.sampling, trained.protocol_sampling) == (None, {"return": Sampling(20)})


def test_a_low_rank_change_is_sampled_as_the_base_that_it_changes(export, tmp_path):
    export(tmp_path / "m", "--steps", "4", "--sampler", "unipc", "--sampling-for", "return:steps=20")
    base = find_checkpoint(tmp_path / "m")
    backbone = load_backbone(base)
    backbone.add_lora(Lora(rank=2))
    (tmp_path / "low").mkdir()
    save_lora(backbone, base, tmp_path / "low", tmp_path / "low")
    changed = find_checkpoint(tmp_path / "low")
    assert (changed.sampling, changed.protocol_sampling) == (base.sampling, base.protocol_sampling)
    assert changed.sampling == Sampling(4, "unipc")


@pytest.fixture
def fast(runs, tmp_path):
    """The run of an adapter that was distilled, on a base that was not."""
    backbone = load_backbone(find_checkpoint(runs / "stage1"))
    backbone.own_sampling = Sampling(1, "consistency")
    return write_adapter(backbone, runs / "stage1", tmp_path / "fast", "map2d")


def test_a_distilled_adapter_is_exported_with_its_own_sampling(persist, runs, fast, tmp_path):
    ended = persist("export", runs / "stage1", fast, "--out", tmp_path / "m")
    assert find_checkpoint(tmp_path / "m").sampling == Sampling(1, "consistency")
    assert "stage1: the model without an adapter is not distilled, and is sampled in 1 step of" in ended.err


def test_adapters_that_are_sampled_in_other_ways_need_options_that_say_how(persist, runs, fast, tmp_path):
    both = ["export", runs / "stage1", runs / "voxel", fast, "--out", tmp_path / "m"]
    failed = persist(*both)
    assert (failed.code, len(failed.err.strip().splitlines())) == (1, 1)
    assert "voxel 50 steps of ddim with guidance 1, map2d 1 step of consistency with guidance 1; give" in failed.err
    assert persist(*both, "--steps", 4, "--sampler", "unipc").code == 0
    assert find_checkpoint(tmp_path / "m").sampling == Sampling(4, "unipc")


def test_a_protocol_is_named_once(persist, runs, tmp_path):
    twice = ("--sampling-for", "return:steps=3", "--sampling-for", "return:guidance=2")
    ended = persist("export", runs / "stage1", *twice, "--out", tmp_path / "m")
    assert (ended.code, "--sampling-for: return is named twice" in ended.err) == (1, True), ended.err


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("retrun:steps=2", "unknown protocol 'retrun'; did you mean 'return'?"),
        ("return:stesp=2", "unknown setting 'stesp'; did you mean 'steps'?"),
        ("return:steps=many", "steps is 'many', which is no number"),
    ],
)
def test_a_sampling_for_a_protocol_that_cannot_be_read_is_one_line(persist, runs, tmp_path, text, cause):
    ended = persist("export", runs / "stage1", "--sampling-for", text, "--out", tmp_path / "m")
    assert (ended.code, cause in ended.err) == (1, True), ended.err
    assert set(PROTOCOL_NAMES) == set(PROTOCOLS)


@pytest.mark.parametrize(
    "value",
    [
        {"steps": "many"},
        {"steps": 0},
        {"steps": True},
        {"stpes": 7},
        {"sampler": 1},
        True,
        {"memory_guidance": -1},
        {"memory_guidance": float("nan")},
        {"memory_guidance": "1"},
    ],
)
def test_a_card_with_an_invalid_sampling_is_refused(export, tmp_path, value):
    export(tmp_path / "m")
    without_sums(tmp_path / "m")
    card = json.loads((tmp_path / "m/persist.json").read_text())
    (tmp_path / "m/persist.json").write_text(json.dumps(card | {"sampling": value}))
    with pytest.raises(CheckpointError, match=r"persist\.json: its sampling is"):
        find_checkpoint(tmp_path / "m")


def test_the_sums_file_has_the_hash_of_every_file(export, runs, tmp_path):
    export(tmp_path / "m", runs / "voxel")
    lines = [line.split("  ") for line in (tmp_path / "m/SHA256SUMS").read_text().splitlines()]
    files = {path.relative_to(tmp_path / "m").as_posix() for path in (tmp_path / "m").rglob("*") if path.is_file()}
    assert files == {name for _, name in lines} | {"SHA256SUMS"}
    assert all(hashlib.sha256((tmp_path / "m" / name).read_bytes()).hexdigest() == sum_ for sum_, name in lines)


def test_the_table_and_json_have_the_size_of_every_file(export, runs, tmp_path):
    assert "adapters/voxel/adapter.safetensors" in export(tmp_path / "m", runs / "voxel")
    record = json.loads(export(tmp_path / "n", runs / "voxel", "--json"))
    sizes = {name: (tmp_path / "n" / name).stat().st_size for name in record["files"]}
    assert sizes == {name: file["bytes"] for name, file in record["files"].items()}
    assert record["bytes"] == sum(sizes.values())
    assert record["fingerprint"] == find_checkpoint(tmp_path / "n").fingerprint
    assert record["default_adapter"] == "voxel"


def test_an_adapter_trained_on_an_export_can_be_exported_with_it(export, persist, runs, tmp_path):
    export(tmp_path / "m")
    model = find_checkpoint(tmp_path / "m")
    later = write_adapter(load_backbone(model), tmp_path / "m", tmp_path / "later", "voxel")
    assert persist("export", tmp_path / "m", later, "--out", tmp_path / "n").code == 0
    assert (find_checkpoint(tmp_path / "n").fingerprint, find_checkpoint(later).fingerprint) == (model.fingerprint,) * 2


def test_an_export_has_the_recipes_of_all_stages_without_absolute_paths(persist, codec, stage1, voxel, tmp_path):
    assert persist("export", stage1, f"codec={voxel}", "--out", tmp_path / "m").code == 0
    home = tmp_path / "m/recipes"
    recipes = {path.relative_to(home).as_posix(): path.read_text() for path in home.rglob("*.yaml")}
    assert sorted(recipes) == ["adapters/codec.yaml", "codec.yaml", "stage1.yaml"]
    assert "base: stage1" in recipes["adapters/codec.yaml"]
    assert "stage: codec" in recipes["codec.yaml"]
    assert not any(str(codec.parent) in text for text in recipes.values())
    assert persist("export", tmp_path / "m", "--out", tmp_path / "again").code == 0
    assert (tmp_path / "m/SHA256SUMS").read_bytes() == (tmp_path / "again/SHA256SUMS").read_bytes()


def test_of_every_place_in_a_recipe_only_the_last_part_is_kept():
    recipe = {
        "base": "/a/run/step-00000004",
        "adapter_from": "/a/adapter",
        "distill": {"teacher": "/a/teacher"},
        "data": {"path": ["/a/houses", "near/houses"]},
        "backbone": {"settings": {"pretrained": "/a/weights", "prompt_embedding": "/a/prompt.safetensors"}},
        "memory": {"settings": {"model": "/a/scene"}},
    }
    assert yaml.safe_load(without_absolute_paths(yaml.safe_dump(recipe), "recipe")) == {
        "base": "run",
        "adapter_from": "adapter",
        "distill": {"teacher": "teacher"},
        "data": {"path": ["houses", "near/houses"]},
        "backbone": {"settings": {"pretrained": "weights", "prompt_embedding": "prompt.safetensors"}},
        "memory": {"settings": {"model": "scene"}},
    }


def test_a_name_is_given_to_one_adapter_and_not_to_several(export, persist, runs, tmp_path):
    export(tmp_path / "two", runs / "voxel", runs / "none")
    ended = persist("export", runs / "stage1", f"mine={tmp_path / 'two'}", "--out", tmp_path / "m")
    assert (ended.code, "NAME=RUN names one adapter, there are none, voxel" in ended.err) == (1, True), ended.err


def test_no_exported_configuration_says_where_it_was_loaded_from(persist, walks, codec, tmp_path):
    settings = ["training.steps=1", "training.ema=0"]
    assert persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", *settings)).code == 0
    run = tmp_path / "run"
    path = next(run.glob("step-*/model/vae/config.json"))  # diffusers writes it into what it loaded itself
    path.write_text(json.dumps(json.loads(path.read_text()) | {"_name_or_path": str(codec)}))
    (path.parents[1] / "SHA256SUMS").unlink()
    assert persist("export", run, "--out", tmp_path / "out").code == 0
    assert not [path for path in (tmp_path / "out").rglob("*.json") if str(codec) in path.read_text()]


def test_an_export_may_be_called_model(persist, walks, stage1, tmp_path):
    model = tmp_path / "runs/model"
    assert persist("export", stage1, "--out", model).code == 0
    assert find_checkpoint(model).name == "model"
    run = persist(*stage("stage2-none", walks, tmp_path / "runs/none", f"base={model}", "training.steps=1"))
    assert run.code == 0, run.err
    assert find_checkpoint(tmp_path / "runs/none").base_folder == model


def test_a_full_disk_ends_an_export_in_one_line_and_leaves_no_file(persist, runs, tmp_path):
    with file_limit(5000):
        ended = persist("export", runs / "stage1", "--out", tmp_path / "m")
    assert (ended.code, "cannot be exported" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_each_impossible_export_ends_in_one_line_and_leaves_no_file(persist, runs, tmp_path):
    (tmp_path / "here").mkdir()
    base, voxel, canvas, out = runs / "stage1", runs / "voxel", runs / "canvas", tmp_path / "m"
    for arguments, cause in (
        ((base, runs / "other", "--out", out), "is of another base than"),
        ((base, voxel, canvas, "--out", out), "adapter 'voxel' is there already, from"),
        ((base, f"a={voxel}", f"a={canvas}", "--out", out), "name this one, as in a-other="),
        ((base, f"stage1={voxel}", "--out", out), "choose another name"),
        ((base, base, "--out", out), "has no memory adapter"),
        ((base, tmp_path / "gone", "--out", out), "no checkpoint there"),
        ((tmp_path / "here", "--out", out), "no checkpoint there"),
        ((base, "--out", tmp_path / "here"), "exists already"),
        ((base, "--dtype", "float61", "--out", out), "did you mean 'float16'"),
        ((base, voxel, "--default", "voxels", "--out", out), "did you mean 'voxel'"),
        ((base, "--sampler", "nonsense", "--out", out), "unknown sampler 'nonsense'"),
        ((base, "--steps", "1001", "--out", out), "1001"),
    ):
        ended = persist("export", *arguments)
        assert (ended.code, cause in ended.err) == (1, True), ended.err
        assert len(ended.err.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_a_value_beyond_float16_is_refused_by_its_name_and_fits_in_bfloat16(persist, tmp_path):
    write_base(tmp_path / "stage1")
    path = tmp_path / "stage1/world.safetensors"
    tensors, metadata = read_tensors(path)
    write_tensors(path, tensors | {"prompt": tensors["prompt"] + 1e5}, metadata)
    refused = persist("export", tmp_path / "stage1", "--out", tmp_path / "m")
    assert refused.code == 1
    assert "world.safetensors: 'prompt' holds 1e+05, more than float16 can (6.55e+04)" in refused.err
    assert [path.name for path in tmp_path.iterdir()] == ["stage1"]
    assert persist("export", tmp_path / "stage1", "--dtype", "bfloat16", "--out", tmp_path / "m").code == 0


def test_one_of_several_adapters_without_a_default_must_be_chosen(export, runs, tmp_path):
    export(tmp_path / "m", runs / "voxel", runs / "none")
    with pytest.raises(CheckpointError, match="choose an adapter of none, voxel with --adapter"):
        find_checkpoint(tmp_path / "m").default_adapter()
