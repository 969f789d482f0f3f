"""The journal of a benchmark of scenes keeps every sample and every walk, so that a stopped run goes on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from persist_cli.evaluate.journal import check_same
from persist_cli.io.files import read_json, read_tensors, remove_leftovers, write_json, write_tensors

IDENTITY: Final = "plan.json"

FOLDER: Final = "parts"


class SceneJournal:
    """The files of a benchmark of scenes.

    What its parts share is its identity. Rows and parts can be added to one that is finished.

    Args:
        out: folder of the benchmark.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.parts = out, out / FOLDER

    def begin(self, identity: dict[str, Any]) -> None:
        """Keep what is measured.

        Raises:
            PersistError: when the folder holds another benchmark than this one.
        """
        if (self.parts / IDENTITY).is_file():
            check_same(read_json(self.parts / IDENTITY), identity, f"{self.out}: holds another benchmark")
        remove_leftovers(self.parts)
        write_json(self.parts / IDENTITY, identity)

    def has(self, part: str, name: str) -> bool:
        """Whether samples or a record were kept."""
        return any(self._file(part, name, suffix).is_file() for suffix in ("safetensors", "json"))

    def write_samples(self, part: str, name: str, tensors: dict[str, Tensor]) -> None:
        """Keep the samples of a view, whole or not at all."""
        write_tensors(self._file(part, name, "safetensors"), tensors)

    def samples(self, part: str, name: str) -> dict[str, Tensor]:
        """What ``write_samples`` kept."""
        return read_tensors(self._file(part, name, "safetensors"))[0]

    def write(self, part: str, name: str, record: dict[str, Any]) -> None:
        """Keep a record of JSON values, whole or not at all."""
        write_json(self._file(part, name, "json"), record)

    def read(self, part: str, name: str) -> dict[str, Any]:
        """What ``write`` kept."""
        return dict(read_json(self._file(part, name, "json")))

    def _file(self, part: str, name: str, suffix: str) -> Path:
        folder, file = (re.sub(r"[^a-z0-9]+", "-", text.lower()) for text in (part, name))
        return self.parts / folder / f"{file}.{suffix}"
