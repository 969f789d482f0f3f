"""DeepSpeed's ZeRO 1 and 2 by accelerate: optimizer state, and in 2 gradients, shared out over the processes.

What accelerate leaves to its user is here: what the recipe decides of DeepSpeed's configuration, that it runs on CPUs
too, and the optimizer's state as it is without DeepSpeed, so that a checkpoint is the same.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Iterable, Iterator, MutableMapping
from typing import Any

import torch
from accelerate import Accelerator, DistributedType
from accelerate.state import PartialState
from accelerate.utils import DeepSpeedPlugin
from torch import Tensor, nn

from persist_cli.training.processes import on_cpus_too
from persist_cli.training.settings import TrainingSettings
from persist_cli.world.errors import PersistError

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
