"""Runs with ``adversarial``: they resume to the bit, end as checkpoints like others, and refuse what cannot be."""

from __future__ import annotations

import pytest

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.stages import Adversarial
from persist_cli.errors import PersistError
from tests.support.micro_model import micro
from tests.support.micro_runs import equal_runs, losses, run_result, stage

AGAINST = ("adversarial.steps=2", "adversarial.width=8")


@pytest.mark.parametrize("number", ["1", "2"])
def test_a_run_resumes_to_the_bit_and_asks_for_its_steps(persist, walks, codec, stage1, tmp_path, number):
    recipe, base = ("stage1", codec) if number == "1" else ("stage2-voxel", stage1)
    runs = {name: stage(recipe, walks, tmp_path / name, f"base={base}") for name in ("plain", "whole", "halves")}
    assert persist(*runs["plain"]).code == 0
    assert persist(*runs["whole"], *AGAINST).code == 0
    for steps, more in ((2, []), (4, ["--resume"])):
        assert persist(*runs["halves"], *AGAINST, f"training.steps={steps}", *more).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")
    assert losses(tmp_path / "whole") != losses(tmp_path / "plain")
    assert any(name.startswith("parameter/discriminator.") for name in run_result(tmp_path / "whole")[0])
    sampling = find_checkpoint(tmp_path / "whole").sampling_with(SamplingOverrides())
    assert (sampling.steps, sampling.sampler) == (2, "ddim")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["stage=codec", "base=null"], "adversarial is for stages 1 and 2, without distill; leave one out"),
        (["distill.levels=4"], "adversarial is for stages 1 and 2, without distill; leave one out"),
        (["adversarial.weight=0"], "adversarial.weight"),
        (["adversarial.steps=0"], "adversarial.steps"),
        (["adversarial.steps=1001"], "this model was trained with 1000 noise levels"),
        (["adversarial.width=none"], "adversarial.width"),
    ],
)
def test_what_cannot_be_ends_in_one_line(persist, walks, codec, tmp_path, changes, message):
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", *AGAINST, *changes))
    assert (ended.code, message in ended.err, len(ended.err.strip().splitlines())) == (1, True, 1), ended.err
    assert not (tmp_path / "run" / "log.jsonl").exists()


def test_a_backbone_that_cannot_says_so():
    with pytest.raises(
        PersistError, match="backbone 'cogvideox' cannot be trained adversarially; leave adversarial out"
    ):
        Backbone.train_adversarially(micro(), Adversarial())  # what backbones have that do not say how
