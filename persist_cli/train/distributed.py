"""Training by several processes: FSDP2, DeepSpeed's ZeRO, and a process that is lost."""

from __future__ import annotations

import contextlib
import copy
import importlib.util
import os
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator, DistributedType, PartialState
from accelerate.state import AcceleratorState
from accelerate.utils import DeepSpeedPlugin, FullyShardedDataParallelPlugin
from torch import Tensor, distributed, nn

from persist_cli.api.backbone import Backbone
from persist_cli.checkpoints.checkpoint import step_folders
from persist_cli.errors import PersistError
from persist_cli.recipe import Recipe, TrainingSettings


def on_cpus_too(kind: DistributedType) -> AcceleratorState | None:
    """The state of processes on CPUs, which then work in this way; ``None`` where they do not work on CPUs.

    torch and DeepSpeed do there what accelerate would put DDP in the place of.
    """
    state = AcceleratorState()
    if state.distributed_type != DistributedType.MULTI_CPU:
        return None
    state.distributed_type = PartialState._shared_state["distributed_type"] = kind
    return state


@contextlib.contextmanager
def lost_processes_named(run: Path) -> Iterator[None]:
    """One line in the place of what torch raises when another process of the run ended or does not answer.

    Raises:
        PersistError: with the checkpoint that the run can go on from.
    """
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and "gloo" not in str(error):
            raise
        state, whole = PartialState(), step_folders(run)
        kept = f"{whole[-1]} is whole, go on with --resume" if whole else f"{run} holds no checkpoint yet"
        raise PersistError(
            f"process {state.process_index} of {state.num_processes} lost another one, which ended or does not answer; "
            f"the launcher names the first that failed; {kept}"
        ) from error


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
        kept = [backbone.get_submodule(name) for name in backbone.never_sharded]
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
    settings, named = recipe.training, ", ".join(backbone.never_sharded)
    if any(each.requires_grad for each in backbone.never_sharded_parameters()):
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


MOMENTS = ("exp_avg", "exp_avg_sq")  # what AdamW keeps of each parameter


def zero_plugin(settings: TrainingSettings) -> DeepSpeedPlugin | None:
    """What ``accelerate launch --use_deepspeed`` and its configuration ask for, ``None`` without it.

    The recipe decides on batch, accumulation, clipping, precision and optimizer.

    Raises:
        PersistError: when DeepSpeed is not installed, and for what it cannot do here.
    """
    if os.environ.get("ACCELERATE_USE_DEEPSPEED", "false").lower() != "true":
        return None
    if importlib.util.find_spec("deepspeed") is None:
        raise PersistError("--use_deepspeed needs the package deepspeed: pip install 'persist-cli[deepspeed]'")
    plugin = DeepSpeedPlugin()
    config = plugin.deepspeed_config
    _check(plugin, config, settings)
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    config["train_micro_batch_size_per_gpu"] = settings.samples_at_once(processes)
    config["gradient_accumulation_steps"] = settings.accumulation
    config["train_batch_size"] = "auto"
    config["gradient_clipping"] = settings.clip
    half = {"enabled": True, "dtype": "bfloat16", "lower_precision_safe_modules": []}  # sums of gradients are float32
    config["torch_autocast"] = half if settings.precision == "bf16" else {"enabled": False}
    return plugin


def zero_on_cpus(plugin: DeepSpeedPlugin | None) -> None:
    """Let processes on CPUs use it as well, where a plugin asks for it."""
    state = on_cpus_too(DistributedType.DEEPSPEED) if plugin is not None else None
    if plugin is not None and state is not None:
        state.deepspeed_plugins = plugin
        plugin.set_mixed_precision("no")
        plugin.select(_from_accelerator_state=True)


def uses_zero(accelerator: Accelerator) -> bool:
    """Whether DeepSpeed does the steps."""
    return bool(accelerator.distributed_type == DistributedType.DEEPSPEED)


@contextlib.contextmanager
def unflattened(parameters: Iterable[nn.Parameter]) -> Iterator[None]:
    """Within the block each parameter has memory of its own: DeepSpeed's are pieces of one, which cannot be saved."""
    flat = [(parameter, parameter.data) for parameter in parameters]
    try:
        for parameter, data in flat:
            parameter.data = data.clone()
        yield
    finally:
        for parameter, data in flat:
            parameter.data = data


class ZeroState(MutableMapping[nn.Parameter, dict[str, Any]]):
    """The state of each parameter in AdamW, as ``Optimizer.state`` has it where nothing is shared out.

    All processes must ask and set together; the main process alone is answered.

    Args:
        optimizer: DeepSpeed's.
        parameters: the trained ones.
    """

    def __init__(self, optimizer: Any, parameters: list[nn.Parameter]) -> None:
        self.optimizer, self.parameters = optimizer, parameters
        self.flat: list[Tensor] = optimizer.single_partition_of_fp32_groups

    def __getitem__(self, parameter: nn.Parameter) -> dict[str, Any]:
        from deepspeed.utils import safe_get_full_optimizer_state

        step = torch.as_tensor(self.optimizer.optimizer.state[self.flat[0]]["step"], dtype=torch.float32).clone()
        found = {key: safe_get_full_optimizer_state(parameter, key) for key in MOMENTS}
        return (
            {"step": step} | {key: each.cpu() for key, each in found.items()} if PartialState().is_main_process else {}
        )

    def __setitem__(self, parameter: nn.Parameter, values: dict[str, Any]) -> None:
        from deepspeed.utils import safe_set_full_fp32_param, safe_set_full_optimizer_state

        self._make(values["step"])
        safe_set_full_fp32_param(parameter, parameter.detach())
        for key in MOMENTS:
            safe_set_full_optimizer_state(parameter, values[key], key)

    def _make(self, step: Tensor) -> None:
        """Room for what AdamW would make in its first step."""
        states = self.optimizer.optimizer.state
        if not states:
            for flat in self.flat:
                states[flat] = {"step": step.clone()} | {key: torch.zeros_like(flat) for key in MOMENTS}
            self.optimizer._lazy_init_hp_params_optimizer_state()

    def __delitem__(self, parameter: nn.Parameter) -> None:
        raise NotImplementedError("DeepSpeed keeps the state of every parameter")

    def __iter__(self) -> Iterator[nn.Parameter]:
        return iter(self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)


def _check(plugin: DeepSpeedPlugin, config: dict[str, Any], settings: TrainingSettings) -> None:
    if plugin.zero_stage not in (1, 2):
        raise PersistError(
            f"--use_deepspeed: ZeRO {plugin.zero_stage} is not supported, 1 and 2 are; to share out weights too, use "
            "--use_fsdp --fsdp_version 2"
        )
    for key in ("optimizer", "scheduler"):
        if key in config:
            raise PersistError(f"--use_deepspeed: the recipe has the {key}; leave it out of DeepSpeed's configuration")
    for kind in ("bf16", "fp16"):
        if config.get(kind, {}).get("enabled") is True:
            raise PersistError(
                f"--use_deepspeed: the recipe has the precision; leave {kind} out of DeepSpeed's configuration"
            )
    if settings.optimizer != "adamw":
        raise PersistError(f"--use_deepspeed: training.optimizer={settings.optimizer} is not shared out; use adamw")
    if settings.frozen_precision != "no":
        raise PersistError("--use_deepspeed: all weights must be of one precision; leave training.frozen_precision out")
