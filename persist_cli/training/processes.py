"""Processes of one run: what CPUs may do that accelerate leaves to GPUs, and what one says when another is gone."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from accelerate import DistributedType, PartialState
from accelerate.state import AcceleratorState
from torch import distributed

from persist_cli.checkpoints import step_folders
from persist_cli.world.errors import PersistError


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
