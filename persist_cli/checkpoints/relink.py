"""The base of a run, found again: when the run is resumed, and by ``persist relink`` when the base was moved."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import (
    CARD,
    SHOWN,
    Checkpoint,
    base_pointer,
    checkpoint_folder,
    find_base,
    find_checkpoint,
    find_weights,
    fingerprints,
    model_folder,
    read_card,
    step_folders,
)
from persist_cli.checkpoints.retention import mark_in_use
from persist_cli.checkpoints.save import card_fingerprint, hash_weights, pointer_to
from persist_cli.errors import CheckpointError
from persist_cli.io.files import json_text
from persist_cli.io.sha256sums import rewrite_files
from persist_cli.output.console import say

HUB_NAME: Final = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")  # owner/model


def run_base(base: str, run: Path) -> Checkpoint:
    """The checkpoint that a run starts from, or the very one that it started from, where the run is to go on.

    Args:
        base: the recipe's base.
        run: the run's folder, which may be missing or empty.

    Raises:
        CheckpointError: when it is not there.
    """
    steps = step_folders(run)
    pointer = base_pointer(read_card(steps[-1] / "model")) if steps else None
    if pointer is None:  # a new run, or one of a version that did not note it
        _check_no_pretrained(base)
        return find_checkpoint(Path(base))
    return find_checkpoint(weights_at(base, pointer) or find_base(steps[-1] / "model", pointer))


def weights_at(place: str, pointer: dict[str, Any]) -> Path | None:
    """The folder of the base that a card's pointer means, if it is at this place, else ``None``."""
    with contextlib.suppress(CheckpointError):
        return find_weights(checkpoint_folder(Path(place)).resolve(), str(pointer["fingerprint"]))
    return None


def _check_no_pretrained(base: str) -> None:
    """Raise ``CheckpointError`` for weights in diffusers' layout, in a folder or on the hub, which are no base."""
    folder = Path(base)
    published = HUB_NAME.fullmatch(base) and not folder.parent.exists()
    if published or ((folder / "transformer").is_dir() and not (folder / CARD).is_file()):
        raise CheckpointError(
            f"base={base}: no checkpoint of persist; for weights of diffusers, in a folder or on the hub, give "
            f"base=null backbone.settings.pretrained={base}"
        )


def run_relink(run: Path, base: Path) -> None:
    """Let the cards of a run point to its base at another place; nothing is changed unless the weights are the same.

    Args:
        run: the run, or a folder with the card of a checkpoint.
        base: the run, checkpoint or export that holds the base now, or ``reference``.

    Raises:
        CheckpointError: when the run stands on no base, or the place holds other weights.
    """
    newest = model_folder(run)
    folders = [step / "model" for step in step_folders(run)] or [newest]
    cards, places = {folder / CARD: read_card(folder) for folder in folders}, set[Path]()
    for path, card in cards.items():
        pointer = base_pointer(card)
        if pointer is None:
            raise CheckpointError(f"{run}: {_without_base(card)}")
        place = _same_weights(run, base, pointer)
        pointer |= pointer_to(place, pointer["fingerprint"], path.parent)
        places.add(place)
    for place in places:
        _check_content(place)
    rewrite_files({path.parent: {CARD: json_text(card)} for path, card in cards.items()})
    for place in places:
        mark_in_use(find_checkpoint(place), run)
        say(f"{run}: its base is now {place}")


def _without_base(card: dict[str, Any]) -> str:
    """Say why there is nothing to relink."""
    pretrained = card.get("changes", {}).get("settings", {}).get("pretrained")
    if pretrained is None:
        return "stands on no other checkpoint, so there is nothing to relink"
    return f"changes the weights of diffusers in {pretrained}, which cannot be relinked; put that folder back"


def _same_weights(run: Path, base: Path, pointer: dict[str, Any]) -> Path:
    place, wanted = checkpoint_folder(base), str(pointer["fingerprint"])
    found = find_weights(place, wanted)
    if found is None:
        there = " and ".join(each[:SHOWN] for each in fingerprints(place))
        cause = f"the fingerprint there is {there}" if there else "no checkpoint is there"
        raise CheckpointError(
            f"{base}: not the base of {run}, whose fingerprint is {wanted[:SHOWN]}; {cause}; nothing is changed"
        )
    return found


def _check_content(folder: Path) -> None:
    """Read all weights of a base and compare them with its card."""
    card = read_card(folder)
    if card_fingerprint(hash_weights(folder), card) != card["fingerprint"]:
        raise CheckpointError(
            f"{folder}: its weights are not those of its card, so copy it again, whole; nothing is changed"
        )
