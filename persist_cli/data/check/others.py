"""What a path holds that is no data set: a memory, a checkpoint, a run, a rollout or an evaluation."""

from __future__ import annotations

from pathlib import Path

from persist_cli.api.checkpoint import (
    CARD,
    CODEC_ALONE,
    GUIDE,
    POLICY_CARD,
    SCENE_CARD,
    STEP,
    checkpoint_folder,
    find_checkpoint,
    read_card,
)
from persist_cli.api.memory_file import is_memory_file, read_header
from persist_cli.io.command_line import quoted
from persist_cli.io.files import read_json

RESULTS = {  # files that name what a folder is
    "rollout.json": "a rollout: look at sheet.png and the videos in it; rollout.json has its figures",
    "metrics.json": "an evaluation: `persist eval --compare {quoted}/metrics.json OTHER.json` compares it with another",
}


def describe_other(path: Path) -> str | None:
    """Return in one line what a path holds and which command looks at it, ``None`` when it may be a data set.

    Raises:
        CheckpointError: when it is a memory file that is damaged, or a checkpoint that is or whose base is missing.
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
    return next((text.format(quoted=quoted(path)) for name, text in RESULTS.items() if (path / name).is_file()), None)


def _describe_policy(path: Path, card: Path) -> str:
    return (
        f"a trained policy of {read_json(card).get('policy')!r}, {card.parent}; "
        f"`persist plan --method rank --policy {quoted(path)}` ranks what it proposes"
    )


def _describe_scene_model(path: Path, card: Path) -> str:
    setting = f"memory.settings.model={quoted(path)}"
    return f"a trained model of scenes, {card.parent}; a memory `scene` imagines with it: {setting}"


def _describe_memory(path: Path) -> str | None:
    """The line about a memory file, ``None`` for any other file."""
    if not is_memory_file(str(path)):
        return None
    header = read_header(path)
    return (
        f"a memory file: {header['memory']} of scene {header['reference']!r}, {header['cells']} cells, "
        f"encoder {header['encoder']}; `persist rollout --memory {quoted(path)} --start DATA#0:0` starts from it, "
        f"{path.with_suffix('.png')} is its map"
    )


def _describe_checkpoint(path: Path) -> str:
    checkpoint = find_checkpoint(path)
    is_run = any(path.glob(f"{STEP}*/model"))
    kind = f"a finetune run, its newest checkpoint {checkpoint.folder.parent.name}" if is_run else "a checkpoint folder"
    adapters, word = ", ".join(checkpoint.adapters), quoted(path)
    parts = f"adapters {adapters}" if adapters else "no memory adapter"
    guide = ", a guide" * (checkpoint.base_folder / GUIDE).is_dir()
    if read_card(checkpoint.base_folder).get(CODEC_ALONE):
        return f"{kind}: backbone {checkpoint.backbone}, a codec alone, for `persist finetune RECIPE … base={word}`"
    return (
        f"{kind}: backbone {checkpoint.backbone}, {parts}{guide}; "
        f"`persist rollout {word} --start DATA#0:0` rolls it out, `persist eval {word} --data DATA` measures it"
    )
