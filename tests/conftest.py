"""What every test may use: the command line in this process, walking data, a micro model."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

os.environ.setdefault("HF_HUB_OFFLINE", "1")
torch.set_num_threads(1)


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


Persist = Callable[..., Ended]


@pytest.fixture
def persist(capsys: pytest.CaptureFixture[str]) -> Persist:
    """The command line, run in this process."""
    from persist_cli.app import main

    def run(*arguments: object) -> Ended:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in arguments])
        printed = capsys.readouterr()
        return Ended(int(ended.value.code or 0), printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two 32×32 walks of 24 frames through the furnished room, there and back, by named actions."""
    from tests.walking import write_walks

    return write_walks(tmp_path_factory.mktemp("walks"))
