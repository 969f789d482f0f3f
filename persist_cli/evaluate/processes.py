"""The processes of ``accelerate launch`` that share an evaluation or a benchmark."""

from __future__ import annotations

from datetime import timedelta
from typing import Final

import torch
from accelerate import PartialState

from persist_cli.train.distributed import explain_lost_processes

LONGEST_WAIT: Final = timedelta(days=7)  # of a process for the slowest one


class Processes:
    """This process among those of ``accelerate launch`` that share an evaluation; without it there is one."""

    def __init__(self) -> None:
        self.state = PartialState(cpu=not torch.cuda.is_available(), timeout=LONGEST_WAIT)

    @property
    def count(self) -> int:
        """Number of processes."""
        return int(self.state.num_processes)

    @property
    def main(self) -> bool:
        """Whether this process is the one that finds the clips and writes the results."""
        return bool(self.state.is_main_process)

    def owns(self, batch: int) -> bool:
        """Whether this process measures a batch; batches are equal for any number of processes."""
        return batch % self.count == int(self.state.process_index)

    def wait(self) -> None:
        """Wait until every process is here.

        Raises:
            PersistError: when another one ended before, as by an error that only the main one finds.
        """
        with explain_lost_processes(lambda: "what was measured is kept, and the same command goes on with it"):
            self.state.wait_for_everyone()
