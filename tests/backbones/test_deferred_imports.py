"""Imports in parts: what a rollout does not use is not executed, and is there as soon as something uses it."""

from __future__ import annotations

import os
import subprocess
import sys

import torch

from persist_cli.api.meta_device import without_weights
from persist_cli.io.files import ENVIRONMENT

UNUSED = ("transformers", "peft", "scipy.stats", "torch._dynamo", "sympy", "diffusers.hooks", "torchmetrics")
ROLLOUT = f"""
import sys
from persist_cli.cli.app import main
try:
    main(["rollout", "--start", "sample#0:32", "--actions", "left", "--steps", "1", "--out", sys.argv[1]])
except SystemExit as ended:
    assert not ended.code
print([name for name in {UNUSED} if name in sys.modules])
"""
STAND_INS = """
from persist_backbones.diffusers_models import CogVideoXDDIMScheduler, CogVideoXTransformer3DModel
import diffusers.models.modeling_utils as loading
import sys, torch
print("diffusers.quantizers" in sys.modules, isinstance(torch.nn.Linear(1, 1), loading.DiffusersQuantizer))
print(loading.DiffusersAutoQuantizer.from_config.__func__.__qualname__, "diffusers.quantizers" in sys.modules)
import diffusers, scipy.stats, transformers, torch._dynamo
from diffusers.hooks import HookRegistry
print(diffusers.CogVideoXTransformer3DModel is CogVideoXTransformer3DModel)
print(diffusers.CogVideoXDDIMScheduler is CogVideoXDDIMScheduler, callable(torch._dynamo.allow_in_graph))
print(float(scipy.stats.norm.cdf(0)), transformers.__version__.count(".") > 0, HookRegistry.__name__)
"""


def python(program: str, *arguments: str) -> list[str]:
    environment = {name: value for name, value in os.environ.items() if name != ENVIRONMENT}  # the bundled model
    command = [sys.executable, "-c", program, *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.splitlines()


def test_a_rollout_executes_nothing_that_it_does_not_use(tmp_path):
    assert python(ROLLOUT, str(tmp_path / "rollout"))[-1] == "[]"


def test_what_was_deferred_is_found_when_it_is_used():
    assert python(STAND_INS) == [
        "False False",
        "DiffusersAutoQuantizer.from_config True",
        "True",
        "True True",
        "0.5 True HookRegistry",
    ]


def test_models_without_weights_are_not_initialised():
    with without_weights():
        layer, table = torch.nn.Linear(2, 3), torch.nn.Embedding(4, 2)
    assert layer.weight.is_meta
    assert layer.bias.is_meta
    assert table.weight.is_meta
    assert layer.weight.shape == (3, 2)
