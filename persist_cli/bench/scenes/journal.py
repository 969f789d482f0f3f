"""The journal of a benchmark of scenes keeps every sample and every walk, so that a stopped run goes on."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from persist_cli.io.begun_with import check_same
from persist_cli.io.files import read_json, read_tensors, remove_leftovers, write_json, write_tensors

IDENTITY: Final = "plan.json"

FOLDER: Final = "parts"


class SceneJournal:
    """The files of a benchmark of scenes.

    It keeps what its parts share and what each part and row depends on beside that. So rows and parts can be added to a
    benchmark that is finished, each with what it alone depends on.

    Args:
        out: folder of the benchmark.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.parts = out, out / FOLDER

    def begin(self, shared: Mapping[str, Any], parts: Mapping[str, Mapping[str, Any]]) -> None:
        """Keep what is measured.

        Args:
            shared: JSON values that all parts depend on.
            parts: what each part or row of this run depends on beside these.

        Raises:
            PersistError: when the folder holds another benchmark than this one, or another one's part of this name.
        """
        kept: dict[str, Any] = {"shared": shared, "parts": {}}
        if (self.parts / IDENTITY).is_file():
            kept = dict(read_json(self.parts / IDENTITY))
            check_same(kept.get("shared"), shared, f"{self.out}: holds another benchmark")
            for name in sorted(kept["parts"].keys() & parts.keys()):
                check_same(kept["parts"][name], parts[name], f"{self.out}: holds {name!r} of another benchmark")
        remove_leftovers(self.parts)
        write_json(self.parts / IDENTITY, kept | {"parts": kept["parts"] | parts})

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
        return self.parts / file_name(part) / f"{file_name(name)}.{suffix}"


def file_name(name: str) -> str:
    """Return the name of a file or folder for any text, another one for each text."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower())
    return plain if plain == name else f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
