"""``persist`` in processes of their own, which can be killed, sent signals, and joined to pairs with gloo.

They are forked from a server that has imported what commands need, because imports take a process several seconds.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        "persist_cli.train.finetune", "persist_cli.evaluate.evaluate", "persist_cli.memorize.build",
        "persist_backbones.extensions.extended", "matplotlib.backends.backend_agg", "torch._dynamo",
    ]
)  # fmt: skip

TIMEOUT = 1800  # seconds, enough for a busy machine


class ForkedProcess:
    """A function in a process of its own.

    Args:
        target: a function of a module, whose return or exit ends the process.
        arguments: its arguments.
        environment: variables that are added to those of this process.
        output: the file that gets what is printed; by default that is thrown away.
    """

    def __init__(
        self,
        target: Callable[..., Any],
        *arguments: Any,
        environment: Mapping[str, str] | None = None,
        output: Path = Path(os.devnull),
    ) -> None:
        variables = {**os.environ, **(environment or {})}
        self._process = SERVER.Process(target=_run, args=(target, arguments, variables, output))
        self._process.start()

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.is_alive()

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def send_to_group(self, number: signal.Signals) -> None:
        """Send it and the processes that it started a signal; it must lead a session."""
        assert self._process.pid is not None
        os.killpg(self._process.pid, number)

    def wait(self) -> int:
        """Wait for its end; the exit code, negative for a signal. It is killed when it takes too long."""
        self._process.join(TIMEOUT)
        if self.running:
            self._process.kill()
            self._process.join()
        assert self._process.exitcode is not None
        return self._process.exitcode


def start_persist(*arguments: object, output: Path = Path(os.devnull)) -> ForkedProcess:
    """Start ``persist`` with these arguments."""
    return ForkedProcess(run_command, [str(argument) for argument in arguments], output=output)


def wait_until(condition: Callable[[], Any], process: ForkedProcess) -> None:
    """Wait until a condition holds, or the process has ended."""
    deadline = time.monotonic() + TIMEOUT
    while not condition() and process.running and time.monotonic() < deadline:
        time.sleep(0.002)


def run_in_pair(target: Callable[..., Any], *arguments: Any, output: Path) -> list[int]:
    """Run a function in two processes as ``start_pair`` does; their exit codes."""
    return [process.wait() for process in start_pair(target, *arguments, output=output)]


def start_pair(
    target: Callable[..., Any], *arguments: Any, output: Path, environment: Mapping[str, str] | None = None
) -> list[ForkedProcess]:
    """Start a function in two processes that find each other as those of ``accelerate launch`` do.

    Args:
        target: the function.
        arguments: its arguments.
        output: a folder for the files ``0.log`` and ``1.log`` with what each printed.
        environment: more variables than those that join the processes.
    """
    shared = {
        "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()),
        "ACCELERATE_USE_CPU": "true", "ACCELERATE_MIXED_PRECISION": "no", "ACCELERATE_DYNAMO_BACKEND": "no",
        **(environment or {}),
    }  # fmt: skip
    return [
        ForkedProcess(
            target, *arguments, environment=shared | {"RANK": rank, "LOCAL_RANK": rank}, output=output / f"{rank}.log"
        )
        for rank in ("0", "1")
    ]


def free_port() -> int:
    """A port of this machine at which nothing listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


def run_command(arguments: list[str]) -> None:
    """Run ``persist`` with these arguments in this process, which ends with its exit code."""
    from persist_cli.cli.app import main

    main(arguments)


def run_in_a_session(arguments: list[str]) -> None:
    """Run ``persist`` as ``run_command`` does, in a session of its own."""
    os.setsid()
    run_command(arguments)


def _run(target: Callable[..., Any], arguments: tuple[Any, ...], variables: dict[str, str], output: Path) -> None:
    """Run a function in a process that looks new: with these variables, torch's one thread, and output in a file."""
    import torch

    os.environ.clear()
    os.environ.update(variables)
    torch.set_num_threads(1)
    with output.open("wb") as file:
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
    target(*arguments)
