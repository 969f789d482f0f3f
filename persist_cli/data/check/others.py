"""What a path holds that is no data set: a memory, a checkpoint, a run, a rollout or an evaluation."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from persist_cli.api.checkpoint import CARD, POLICY_CARD, SCENE_CARD, STEP, checkpoint_folder, find_checkpoint
from persist_cli.io.files import read_json

RESULTS = {  # files that name what a folder is
    "rollout.json": "a rollout: look at sheet.png and the videos in it; rollout.json has its figures",
    "metrics.json": "an evaluation: `persist eval --compare {path}/metrics.json OTHER.json` compares it with another",
}


def describe_other(path: Path) -> str | None:
    """Return in one line what a path holds and which command looks at it, ``None`` when it may be a data set.

    Raises:
        CheckpointError: when it is a checkpoint that is damaged or whose base is missing.
    """
    if any(path.glob("*.parquet")):
        return None
    if path.is_file():
        return _describe_memory(path)
    for name, describe in ((POLICY_CARD, _describe_policy), (SCENE_CARD, _describe_scene_model)):
        patterns = (name, f"model/{name}", f"{STEP}*/model/{name}")  # of a folder, a checkpoint, a run
        cards = [card for pattern in patterns for card in sorted(path.glob(pattern), reverse=True)]
        if cards:
            return describe(path, cards[0])
    patterns = (CARD, f"model/{CARD}", f"{STEP}*/model")  # of a folder, a checkpoint, a run
    if any(any(checkpoint_folder(path).glob(pattern)) for pattern in patterns):
        return _describe_checkpoint(path)
    return next((text.format(path=path) for name, text in RESULTS.items() if (path / name).is_file()), None)


def _describe_policy(path: Path, card: Path) -> str:
    return (
        f"a trained policy of {read_json(card).get('policy')!r}, {card.parent}; "
        f"`persist plan --method rank --policy {path}` ranks what it proposes"
    )


def _describe_scene_model(path: Path, card: Path) -> str:
    return f"a trained model of scenes, {card.parent}; a memory `scene` imagines with it: memory.settings.model={path}"


def _describe_memory(path: Path) -> str | None:
    """The line about a memory file, ``None`` for any other file."""
    from safetensors import SafetensorError, safe_open

    header = None
    with contextlib.suppress(SafetensorError, OSError, ValueError), safe_open(path, framework="pt") as file:
        header = json.loads((file.metadata() or {}).get("persist", "null"))
    if not isinstance(header, dict) or header.get("format") != "persist-memory":
        return None
    return (
        f"a memory file: {header.get('memory')} of scene {header.get('reference')!r}, {header.get('cells')} cells, "
        f"encoder {header.get('encoder')}; `persist rollout --memory {path} --start DATA#0:0` starts from it, "
        f"{path.with_suffix('.png')} is its map"
    )


def _describe_checkpoint(path: Path) -> str:
    checkpoint = find_checkpoint(path)
    is_run = any(path.glob(f"{STEP}*/model"))
    kind = f"a finetune run, its newest checkpoint {checkpoint.folder.parent.name}" if is_run else "a checkpoint folder"
    adapters = ", ".join(checkpoint.adapters)
    return (
        f"{kind}: backbone {checkpoint.backbone}, {f'adapters {adapters}' if adapters else 'no memory adapter'}; "
        f"`persist rollout {path} --start DATA#0:0` rolls it out, `persist eval {path} --data DATA` measures it"
    )
