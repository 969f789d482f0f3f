"""Training by several processes: FSDP2, DeepSpeed's ZeRO, and what is said when a process is lost."""

from __future__ import annotations

import contextlib
import copy
import importlib.util
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any, Final

import torch
from accelerate import Accelerator, DistributedType, PartialState
from accelerate.state import AcceleratorState
from accelerate.utils import DeepSpeedPlugin, FullyShardedDataParallelPlugin
from torch import Tensor, distributed, nn

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import step_folders
from persist_cli.errors import PersistError
from persist_cli.recipe import Recipe
from persist_cli.training_settings import TrainingSettings

CHECKPOINT_WRAPPER: Final = "_checkpoint_wrapped_module."  # accelerate's activation checkpointing adds it to names

MOMENTS: Final = ("exp_avg", "exp_avg_sq")  # what AdamW keeps of each parameter


@contextlib.contextmanager
def explain_lost_processes(way_on: Callable[[], str]) -> Iterator[None]:
    """Replace torch's error about another process that ended or does not answer by one line.

    Args:
        way_on: says what was kept, and how to go on with it.

    Raises:
        PersistError: that line.
    """
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and "gloo" not in str(error):
            raise
        state = PartialState()
        raise PersistError(
            f"process {state.process_index} of {state.num_processes} lost another one, which ended or does not answer; "
            f"the launcher names the first that failed; {way_on()}"
        ) from error


def last_checkpoint(run: Path) -> str:
    """In words, the checkpoint that a run can go on from."""
    checkpoints = step_folders(run)
    return f"{checkpoints[-1]} is whole, go on with --resume" if checkpoints else f"{run} holds no checkpoint yet"


def fsdp_plugin(precision: str) -> FullyShardedDataParallelPlugin | None:
    """The configuration of FSDP2 that ``accelerate launch --use_fsdp`` asks for, ``None`` without it.

    Args:
        precision: ``no`` or ``bf16``. With bf16 weights are sent and used in bf16, and gradients summed in float32.

    Raises:
        PersistError: for FSDP 1, and for shards by size.
    """
    if os.environ.get("ACCELERATE_USE_FSDP", "false").lower() != "true":
        return None
    if os.environ.get("FSDP_VERSION", "1") != "2":
        raise PersistError("--use_fsdp: only FSDP2 is supported; add --fsdp_version 2 to accelerate launch")
    if os.environ.get("FSDP_AUTO_WRAP_POLICY", "").upper() == "SIZE_BASED_WRAP":
        raise PersistError(
            "--fsdp_auto_wrap_policy SIZE_BASED_WRAP: FSDP2 does not shard the lists that blocks are in; leave it out, "
            "and blocks are sharded one by one"
        )
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


def use_fsdp_on_cpus(plugin: FullyShardedDataParallelPlugin | None) -> None:
    """Let processes on CPUs shard too, where FSDP2 is configured."""
    state = _replace_ddp_on_cpus(DistributedType.FSDP) if plugin is not None else None
    if state is not None:
        state.fsdp_plugin = plugin


def is_sharded(parameter: Tensor) -> bool:
    """Whether this process holds only a part of the parameter."""
    return hasattr(parameter, "full_tensor")


def check_sharded(recipe: Recipe, backbone: Backbone) -> None:
    """Raise ``PersistError`` when a recipe asks for what cannot be sharded; its stage's parameters are unfrozen."""
    settings, names = recipe.training, ", ".join(backbone.never_sharded)
    if any(parameter.requires_grad for parameter in backbone.never_sharded_parameters()):
        raise PersistError(f"--use_fsdp: stage {recipe.stage} trains {names}, which is not sharded; use --multi_gpu")
    if settings.optimizer != "adamw":
        raise PersistError(f"--use_fsdp: training.optimizer={settings.optimizer} is not sharded; use adamw")
    if settings.frozen_precision != "no" and recipe.stage != "2":
        raise PersistError("--use_fsdp: training.frozen_precision is for stage 2 there; leave it out")


class Sharding:
    """Prepares a backbone for FSDP2 and puts it together again to be saved.

    Args:
        backbone: the backbone, before accelerate prepares it.
        recipe: the recipe of the training.
        accelerator: shards the backbone later, block by block; the launcher may choose the classes of the blocks, else
            they are ``Backbone.sharded_blocks``.

    Raises:
        PersistError: when the recipe asks for what cannot be sharded.
    """

    def __init__(self, backbone: Backbone, recipe: Recipe, accelerator: Accelerator) -> None:
        check_sharded(recipe, backbone)
        never_sharded = [backbone.get_submodule(name) for name in backbone.never_sharded]
        self.backbone, self.saves_all = backbone, recipe.stage != "2" and recipe.lora is None
        self.trained = {name for name, parameter in backbone.named_parameters() if parameter.requires_grad}
        self.whole = _without_weights(backbone, never_sharded)
        for module in never_sharded:
            module.to(accelerator.device)
        plugin = accelerator.state.fsdp_plugin
        plugin.ignored_modules = never_sharded
        if not _launcher_names_blocks():
            _shard_blocks(plugin, backbone)

    def parameters(self) -> dict[str, nn.Parameter]:
        """The trained parameters by name, once accelerate has replaced them by sharded ones."""
        names = ((name.replace(CHECKPOINT_WRAPPER, ""), value) for name, value in self.backbone.named_parameters())
        return {name: parameter for name, parameter in names if name in self.trained}

    @contextlib.contextmanager
    def gathered(self, averages: Mapping[str, Tensor], main: bool) -> Iterator[Backbone]:
        """Within the block the main process has the backbone with all weights that are saved, on the CPU.

        In stage 2 these are the adapter's, with LoRA those that are trained. Parameters are gathered one after the
        other; all processes must enter.

        Args:
            averages: parameters to save in the place of the trained ones, by name.
            main: whether this is the main process; on the others the backbone has no weights.
        """
        weights: dict[str, Tensor] = {}
        for name, parameter in self.backbone.named_parameters():
            name = name.replace(CHECKPOINT_WRAPPER, "")
            if is_sharded(parameter) and (self.saves_all or name in self.trained):
                part = averages.get(name, parameter).detach().to(parameter.device)  # averages may be on the CPU
                whole: Tensor = part.full_tensor()  # type: ignore[attr-defined]
                if main:
                    weights[name] = whole.cpu()
        self.whole.load_state_dict(weights, strict=False, assign=True)
        try:
            yield self.whole
        finally:
            empty = {name: torch.empty_like(weight, device="meta") for name, weight in weights.items()}
            self.whole.load_state_dict(empty, strict=False, assign=True)


def zero_plugin(settings: TrainingSettings) -> DeepSpeedPlugin | None:
    """The configuration of ZeRO that ``accelerate launch --use_deepspeed`` asks for, ``None`` without it.

    Batch, accumulation, clipping, precision and optimizer are the recipe's.

    Raises:
        PersistError: when DeepSpeed is not installed, and for what it cannot do here.
    """
    if os.environ.get("ACCELERATE_USE_DEEPSPEED", "false").lower() != "true":
        return None
    if importlib.util.find_spec("deepspeed") is None:
        raise PersistError("--use_deepspeed needs the package deepspeed: pip install 'persist-cli[deepspeed]'")
    plugin = DeepSpeedPlugin()
    config = plugin.deepspeed_config
    _check_zero(plugin.zero_stage, config, settings)
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    config["train_micro_batch_size_per_gpu"] = settings.samples_at_once(processes)
    config["gradient_accumulation_steps"] = settings.accumulation
    config["train_batch_size"] = "auto"
    config["gradient_clipping"] = settings.clip
    half = {"enabled": True, "dtype": "bfloat16", "lower_precision_safe_modules": []}  # sums of gradients are float32
    config["torch_autocast"] = half if settings.precision == "bf16" else {"enabled": False}
    return plugin


def use_zero_on_cpus(plugin: DeepSpeedPlugin | None) -> None:
    """Let processes on CPUs use ZeRO too, where it is configured."""
    state = _replace_ddp_on_cpus(DistributedType.DEEPSPEED) if plugin is not None else None
    if plugin is not None and state is not None:
        state.deepspeed_plugins = plugin
        plugin.set_mixed_precision("no")
        plugin.select(_from_accelerator_state=True)


def uses_zero(accelerator: Accelerator) -> bool:
    """Whether DeepSpeed takes the optimizer steps."""
    return bool(accelerator.distributed_type == DistributedType.DEEPSPEED)


def refuse_sharding(accelerator: Accelerator, what: str) -> None:
    """Raise ``PersistError`` when the launcher asks to shard what is small and not sharded."""
    if accelerator.is_fsdp2 or uses_zero(accelerator):
        raise PersistError(f"{what} not sharded; launch with --multi_gpu")


@contextlib.contextmanager
def unflattened(parameters: Iterable[nn.Parameter]) -> Iterator[None]:
    """Within the block each parameter has memory of its own; DeepSpeed's are pieces of one and cannot be saved."""
    pieces = [(parameter, parameter.data) for parameter in parameters]
    try:
        for parameter, data in pieces:
            parameter.data = data.clone()
        yield
    finally:
        for parameter, data in pieces:
            parameter.data = data


class ZeroState(MutableMapping[nn.Parameter, dict[str, Any]]):
    """AdamW's state of each parameter, as ``Optimizer.state`` has it where nothing is shared out.

    All processes must read and write together; only the main process gets values.

    Args:
        optimizer: DeepSpeed's optimizer.
        parameters: the trained parameters.
    """

    def __init__(self, optimizer: Any, parameters: list[nn.Parameter]) -> None:
        self.optimizer, self.parameters = optimizer, parameters
        self.partitions: list[Tensor] = optimizer.single_partition_of_fp32_groups

    def __getitem__(self, parameter: nn.Parameter) -> dict[str, Any]:
        from deepspeed.utils import safe_get_full_optimizer_state

        step = self.optimizer.optimizer.state[self.partitions[0]]["step"]
        moments = {key: safe_get_full_optimizer_state(parameter, key) for key in MOMENTS}
        if not PartialState().is_main_process:
            return {}
        steps = {"step": torch.as_tensor(step, dtype=torch.float32).clone()}
        return steps | {key: moment.cpu() for key, moment in moments.items()}

    def __setitem__(self, parameter: nn.Parameter, values: dict[str, Any]) -> None:
        from deepspeed.utils import safe_set_full_fp32_param, safe_set_full_optimizer_state

        self._make_empty_state(values["step"])
        safe_set_full_fp32_param(parameter, parameter.detach())
        for key in MOMENTS:
            safe_set_full_optimizer_state(parameter, values[key], key)

    def _make_empty_state(self, step: Tensor) -> None:
        """Make the tensors that AdamW would make in its first step."""
        states = self.optimizer.optimizer.state
        if not states:
            for partition in self.partitions:
                states[partition] = {"step": step.clone()} | {key: torch.zeros_like(partition) for key in MOMENTS}
            self.optimizer._lazy_init_hp_params_optimizer_state()

    def __delitem__(self, parameter: nn.Parameter) -> None:
        raise NotImplementedError("DeepSpeed keeps the state of every parameter")

    def __iter__(self) -> Iterator[nn.Parameter]:
        return iter(self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)


def _replace_ddp_on_cpus(kind: DistributedType) -> AcceleratorState | None:
    """Switch several processes on CPUs from DDP, which accelerate chooses for them, to this kind of training.

    Returns:
        The changed state, ``None`` where there is one process or the processes are not on CPUs.
    """
    state = AcceleratorState()
    if state.distributed_type != DistributedType.MULTI_CPU:
        return None
    state.distributed_type = PartialState._shared_state["distributed_type"] = kind
    return state


def _launcher_names_blocks() -> bool:
    """Whether the launcher says what is sharded apart.

    ``accelerate config`` writes a policy by classes that names none, and means those of the model itself. Accelerate
    knows these of transformers' models alone; of others it would gather all weights at once.
    """
    policy = os.environ.get("FSDP_AUTO_WRAP_POLICY", "").upper()
    return bool(os.environ.get("FSDP_TRANSFORMER_CLS_TO_WRAP") if policy == "TRANSFORMER_BASED_WRAP" else policy)


def _shard_blocks(plugin: FullyShardedDataParallelPlugin, backbone: Backbone) -> None:
    from torch.distributed.fsdp.wrap import transformer_auto_wrap_policy

    classes = {type(module).__name__ for module in backbone.modules()}
    plugin.auto_wrap_policy = transformer_auto_wrap_policy
    plugin.transformer_cls_names_to_wrap = [name for name in backbone.sharded_blocks if name in classes]


def _without_weights(backbone: Backbone, shared: list[nn.Module]) -> Backbone:
    """A copy with its parameters on the meta device, except those of the modules that it shares with the original."""
    copies: dict[int, object] = {id(module): module for module in shared}
    for parameter in backbone.parameters():
        copies[id(parameter)] = nn.Parameter(parameter.detach().to("meta"), requires_grad=parameter.requires_grad)
    return copy.deepcopy(backbone, copies)


def _check_zero(zero_stage: int, config: dict[str, Any], settings: TrainingSettings) -> None:
    if zero_stage not in (1, 2):
        raise PersistError(
            f"--use_deepspeed: ZeRO {zero_stage} is not supported, 1 and 2 are; to share out weights too, use "
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
