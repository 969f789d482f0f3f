"""Batches of samples, read by processes of their own, and what becomes of these when the run ends or they do."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator, Iterator
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from multiprocessing import resource_tracker
from typing import Any, Final

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from persist_cli.errors import PersistError
from persist_cli.io.signals import STOPPING
from persist_cli.train.packing import pack_shared, unpack

LONGEST_READ: Final = timedelta(minutes=30)  # of a batch; other processes wait longer, so that this is what is said


def outlive_signals(_worker: int) -> None:
    """Let a process that reads data go on when all processes get a signal: the run ends it, after its checkpoint."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def held_back_signals() -> Iterator[None]:
    """Within the block signals that stop a run never reach processes that begin in it anew, without a fork.

    The thread holds them back, and so do processes that it begins. These take seconds until ``outlive_signals`` runs in
    them, and would end by a signal to all processes before. So they do on Windows still, which cannot hold one back.
    """
    if multiprocessing.get_start_method() == "fork" or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # when it begins, it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def explain_lost_readers() -> Iterator[None]:
    """Replace torch's error about a process that reads data, and ended or does not answer, by one line.

    Torch raises it at any time, also between two batches.

    Raises:
        PersistError: that line.
    """
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("DataLoader "):
            raise
        raise PersistError(
            f"a process that reads data was lost ({' '.join(str(error).split())}); check the free memory, and the disk "
            "or server of the data; training.workers=0 reads without such processes"
        ) from error


def end_readers(batches: Any) -> None:
    """End the processes of a loader's iterator; also one that hangs, for which the program would wait at its end."""
    if hasattr(batches, "_shutdown_workers"):
        batches._shutdown_workers()
        for reader in batches._workers:
            reader.kill()  # it outlives the signal that torch sends


class CaughtErrors(Dataset[Any]):
    """The samples of a data set; an error that the user can mend stands in the place of the sample that it is about.

    Raised in a process that reads data, its one line would come back with that process's traceback.

    Args:
        dataset: the data set.
    """

    def __init__(self, dataset: Dataset[Any]) -> None:
        self.dataset = dataset

    def __getitem__(self, number: int) -> Any:
        try:
            return self.dataset[number]
        except PersistError as error:
            return error


def read_batches(dataset: Dataset[Any], batches: Sampler[list[int]], workers: int) -> Generator[list[Any], None, None]:
    """Read batches of samples, ahead of their use where processes do it.

    Args:
        dataset: the samples.
        batches: the numbers of the samples of each batch.
        workers: the processes that read; 0 reads in this one.

    Raises:
        PersistError: when a sample cannot be read, whichever process reads it.
    """
    loader: DataLoader[Any] = DataLoader(
        CaughtErrors(dataset),
        batch_sampler=batches,
        num_workers=workers,
        collate_fn=pack_shared if workers else list,
        timeout=LONGEST_READ.total_seconds() if workers else 0,
        worker_init_fn=outlive_signals,
        generator=torch.Generator(),  # of its own: the loader must not draw from the run's random state
    )
    with held_back_signals() if workers else nullcontext():
        remaining = iter(loader)
    try:
        while True:
            read = next(remaining, None)
            if read is None:
                return
            samples = unpack(read) if workers else read
            errors = [sample for sample in samples if isinstance(sample, PersistError)]
            if errors:
                raise errors[0]
            yield samples
    finally:
        end_readers(remaining)  # now, and not when the traceback of an error is forgotten
