"""The processes of ``accelerate launch`` that share an evaluation; one without it."""

from __future__ import annotations

from datetime import timedelta

import torch
from accelerate import PartialState

LONGEST = timedelta(days=7)  # a process may wait this long for the slowest


class Processes:
    """This process among those of the run."""

    def __init__(self) -> None:
        self.state = PartialState(cpu=not torch.cuda.is_available(), timeout=LONGEST)

    @property
    def count(self) -> int:
        """How many there are."""
        return int(self.state.num_processes)

    @property
    def main(self) -> bool:
        """Whether this one finds the clips and writes the results."""
        return bool(self.state.is_main_process)

    def mine(self, number: int) -> bool:
        """Whether a batch is this process's to measure; batches are the same for any number of processes."""
        return number % self.count == int(self.state.process_index)

    def wait(self) -> None:
        """Until every process is here."""
        self.state.wait_for_everyone()
