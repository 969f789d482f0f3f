import json

import pytest
from PIL import Image

from persist_backbones.cogvideox.diffusion import SAMPLERS
from persist_cli.api.inference import CONSISTENCY
from persist_cli.errors import CheckpointError
from tests.benchmarks.bench_sampling import fresh_model, main
from tests.support.micro_runs import MICRO

NAMES = [*SAMPLERS, CONSISTENCY]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return fresh_model(tmp_path_factory.mktemp("model"), MICRO)


def test_samplers_and_memories_are_compared_on_clips_that_return(model, held_out, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))  # without weights of LPIPS
    sizes = ["--clips", "2", "--steps", "3,1", "--guidance", "1.5"]
    main(["--checkpoint", *map(str, model), "--data", str(held_out), *sizes, "--out", str(tmp_path)])
    results = json.loads((tmp_path / "sampling.json").read_text())
    samplers, memories = results["samplers"], results["memories"]
    assert [(row["sampler"], row["steps"]) for row in samplers] == [(name, n) for name in NAMES for n in (3, 1)]
    assert {row["memory_guidance"] for row in samplers} == {1.5}
    assert samplers[0]["ratio"] == 1.0
    single = [row["psnr"] for row in samplers if row["steps"] == 1]
    assert single == pytest.approx([single[0]] * len(NAMES), abs=0.01)  # one step is one prediction for all of them
    assert [row["memory"] for row in memories] == ["stage1", "none", "voxel"]
    assert memories[1]["ratio"] == 1.0
    assert len(results["clips"]) == 2
    assert Image.open(tmp_path / "sampling.png").width > 0
    printed = capsys.readouterr().out
    assert "lpips-alex: n/a (weights lpips-alex are not here" in printed
    assert "time to ddim 3" in printed


def test_a_memory_that_no_checkpoint_has_is_an_error(model, held_out):
    with pytest.raises(CheckpointError, match="no checkpoint has a memory adapter 'map2d'; there are: none, voxel"):
        main(["--checkpoint", *map(str, model), "--data", str(held_out), "--adapter", "map2d"])


def test_a_checkpoint_without_data_is_refused(model):
    with pytest.raises(SystemExit):
        main(["--checkpoint", str(model[0])])
