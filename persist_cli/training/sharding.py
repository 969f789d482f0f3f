"""FSDP2 by accelerate: weights, gradients, averages and optimizer state shared out over the processes.

What accelerate leaves to its user is here: that it runs on CPUs too, which blocks are put together one by one, what
stays whole, the precision, and a whole model again where one is saved.
"""

from __future__ import annotations

import contextlib
import copy
import os
from collections.abc import Iterator, Mapping

import torch
from accelerate import Accelerator, DistributedType
from accelerate.utils import FullyShardedDataParallelPlugin
from torch import Tensor, nn

from persist_cli.recipe import Recipe
from persist_cli.training.processes import on_cpus_too
from persist_cli.world.backbone import Backbone
from persist_cli.world.errors import PersistError

WRAPPER = "_checkpoint_wrapped_module."  # what accelerate's activation checkpointing adds to names


def sharding_plugin(precision: str) -> FullyShardedDataParallelPlugin | None:
    """What ``accelerate launch --use_fsdp`` asks for, ``None`` without it.

    Args:
        precision: ``no`` or ``bf16``. In bf16 weights travel and compute in it, gradients are summed in float32.

    Raises:
        PersistError: for FSDP 1.
    """
    if os.environ.get("ACCELERATE_USE_FSDP", "false").lower() != "true":
        return None
    if os.environ.get("FSDP_VERSION", "1") != "2":
        raise PersistError("--use_fsdp: only FSDP2 is supported; add --fsdp_version 2 to accelerate launch")
    from torch.distributed.fsdp import CPUOffloadPolicy, MixedPrecisionPolicy

    half = MixedPrecisionPolicy(torch.bfloat16, torch.float32, cast_forward_inputs=False)
    plugin = FullyShardedDataParallelPlugin(
        fsdp_version=2,
        mixed_precision_policy=half if precision == "bf16" else None,
        cpu_ram_efficient_loading=False,  # every process reads the weights itself
    )
    if isinstance(plugin.cpu_offload, CPUOffloadPolicy) and not torch.cuda.is_available():
        plugin.cpu_offload = CPUOffloadPolicy(pin_memory=False)  # there is nothing to pin it for
    return plugin


def shard_on_cpus(plugin: FullyShardedDataParallelPlugin | None) -> None:
    """Let processes on CPUs shard as well, where a plugin asks for it."""
    state = on_cpus_too(DistributedType.FSDP) if plugin is not None else None
    if state is not None:
        state.fsdp_plugin = plugin


def is_sharded(parameter: Tensor) -> bool:
    """Whether this process holds a part of it only."""
    return hasattr(parameter, "full_tensor")


class Sharding:
    """A backbone about to be sharded: what to do with which part of it, and how it looks whole.

    Args:
        backbone: not prepared by accelerate yet.
        recipe: of the training.
        accelerator: that will shard it; blocks that the launcher did not choose are those of the backbone.

    Raises:
        PersistError: when the recipe asks for what cannot be sharded.
    """

    def __init__(self, backbone: Backbone, recipe: Recipe, accelerator: Accelerator) -> None:
        check_sharded(recipe, backbone)
        kept = [backbone.get_submodule(name) for name in backbone.kept_whole]
        self.backbone, self.all_saved = backbone, recipe.stage != "2" and recipe.lora is None
        self.trained = {name for name, each in backbone.named_parameters() if each.requires_grad}
        self.whole = _without_weights(backbone, kept)
        for module in kept:
            module.to(accelerator.device)
        plugin = accelerator.state.fsdp_plugin
        plugin.ignored_modules = kept
        if "FSDP_AUTO_WRAP_POLICY" not in os.environ:
            _shard_blocks(plugin, backbone)

    def parameters(self) -> dict[str, nn.Parameter]:
        """The trained parameters by name, after accelerate has put others in their place."""
        named = ((name.replace(WRAPPER, ""), each) for name, each in self.backbone.named_parameters())
        return {name: each for name, each in named if name in self.trained}

    @contextlib.contextmanager
    def gathered(self, instead: Mapping[str, Tensor], main: bool) -> Iterator[Backbone]:
        """The whole backbone on the main process's CPU, one parameter after the other; all processes must enter.

        In stage 2 the adapter only, and of LoRA what is trained: all that is saved.

        Args:
            instead: what stands for some of the parameters by name, as their averages do.
            main: whether this is the main process; on the others it has no weights.
        """
        found: dict[str, Tensor] = {}
        for name, parameter in self.backbone.named_parameters():
            name = name.replace(WRAPPER, "")
            if is_sharded(parameter) and (self.all_saved or name in self.trained):
                part = instead.get(name, parameter).detach().to(parameter.device)  # averages may be elsewhere
                whole: Tensor = part.full_tensor()  # type: ignore[attr-defined]
                if main:
                    found[name] = whole.cpu()
        self.whole.load_state_dict(found, strict=False, assign=True)
        try:
            yield self.whole
        finally:
            nothing = {name: torch.empty_like(each, device="meta") for name, each in found.items()}
            self.whole.load_state_dict(nothing, strict=False, assign=True)


def check_sharded(recipe: Recipe, backbone: Backbone) -> None:
    """Raise ``PersistError`` when a recipe asks for what cannot be sharded; its stage's parameters are unfrozen."""
    settings, named = recipe.training, ", ".join(backbone.kept_whole)
    if any(each.requires_grad for each in backbone.whole_parameters()):
        raise PersistError(f"--use_fsdp: stage {recipe.stage} trains {named}, which is not sharded; use --multi_gpu")
    if settings.optimizer != "adamw":
        raise PersistError(f"--use_fsdp: training.optimizer={settings.optimizer} is not sharded; use adamw")
    if settings.frozen_precision != "no" and recipe.stage != "2":
        raise PersistError("--use_fsdp: training.frozen_precision is for stage 2 there; leave it out")


def _shard_blocks(plugin: FullyShardedDataParallelPlugin, backbone: Backbone) -> None:
    from torch.distributed.fsdp.wrap import transformer_auto_wrap_policy

    there = {type(module).__name__ for module in backbone.modules()}
    plugin.auto_wrap_policy = transformer_auto_wrap_policy
    plugin.transformer_cls_names_to_wrap = [name for name in backbone.sharded_blocks if name in there]


def _without_weights(backbone: Backbone, kept: list[nn.Module]) -> Backbone:
    """A copy whose parameters are on the meta device, except those of the modules that it shares with the original."""
    shared: dict[int, object] = {id(module): module for module in kept}
    for parameter in backbone.parameters():
        shared[id(parameter)] = nn.Parameter(parameter.detach().to("meta"), requires_grad=parameter.requires_grad)
    return copy.deepcopy(backbone, shared)
