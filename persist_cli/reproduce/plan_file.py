"""What a folder of trials is measured with: figures of another base, of other data or clips never go under its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.errors import PersistError
from persist_cli.evaluate.provenance import checkpoint_json
from persist_cli.io.begun_with import check_same
from persist_cli.io.files import plain, read_json, write_json

PLAN: Final = "plan.json"


def keep_plan(out: Path, values: Mapping[str, Any], results: str = "eval/**/metrics.json") -> None:
    """Write ``OUT/plan.json``, or check that what is there says the same.

    Args:
        out: folder of the trials.
        values: all that changes a figure, as JSON values.
        results: pattern of files in it of which the plan tells what they are of.

    Raises:
        PersistError: when the folder holds results of another plan, or results without a plan.
    """
    path, now = out / PLAN, plain(values)
    if path.is_file():
        check_same(read_json(path), now, f"{out}: holds trials of another plan")
    elif any(out.glob(results)):
        raise PersistError(f"{out}: holds results but no {PLAN}, which says of what; choose another OUT or delete it")
    out.mkdir(parents=True, exist_ok=True)
    write_json(path, now)


def base_json(base: str) -> dict[str, str]:
    """The place of a base and the hash of its weights; ``CheckpointError`` when there is none."""
    place = str(Path(base).resolve()) if Path(base).is_dir() else base
    return {"path": place, "fingerprint": find_checkpoint(Path(base)).fingerprint}


def model_json(model: str) -> dict[str, Any]:
    """The place of a model with the hashes of its weights and adapters; ``CheckpointError`` when there is none."""
    hashes = checkpoint_json(find_checkpoint(Path(model)))
    return {"path": model} | {key: hashes[key] for key in ("fingerprint", "adapters", "adapter_settings")}


def places(folders: Sequence[Path]) -> list[str]:
    """The full paths of some folders, as JSON values."""
    return [str(folder.resolve()) for folder in folders]
