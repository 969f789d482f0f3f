"""Checkpoints on disk: one base, and small memory adapters that load onto it by name.

A checkpoint's folder holds the card ``persist.json``, the backbone's own files and ``adapters/NAME/``. The folder of a
stage-2 run holds adapters only, and its card says where the base is. The folder of a LoRA run holds the low-rank
change, and its card says which weights it changes. A run's folder stands for its newest checkpoint, and the name
``reference`` for the model that comes with the package; ``reference-1step`` is the same, distilled to one step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.inference import Sampling, SamplingOverrides
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.errors import CheckpointError, PersistError, nearest_name
from persist_cli.io.command_line import quoted
from persist_cli.io.files import bundled_folder, read_json
from persist_cli.io.sha256sums import check_sums

CARD: Final = "persist.json"
POLICY_CARD: Final = "policy.json"  # of a trained policy, which is no world model
SCENE_CARD: Final = "scene.json"  # of a trained model of scenes, which is none either
WEIGHTS: Final = ".safetensors"
VERSION: Final = 1
STEP: Final = "step-"  # start of the names of the folders of a run's checkpoints
PLAIN: Final = "stage1"  # name of the base without any adapter
REFERENCE: Final = "reference"  # names the model that comes with the package
ONE_STEP: Final = "reference-1step"  # and this one what was distilled from it to one denoising step
PACKAGED: Final = (REFERENCE, ONE_STEP)
STARTED_FROM: Final = "started_from"  # the key of a card for the base of a run that holds all weights itself
GUIDE: Final = "guide"  # the folder of a weaker version of a checkpoint's video model, for autoguidance
CODEC_ALONE: Final = "codec_alone"  # the key of a card for a codec that was exported without its video model
SAMPLING_TYPES: Final = {  # a bool is no int here
    "steps": (int,),
    "sampler": (str,),
    "memory_guidance": (int, float),
    "context_noise": (int, float),
    "autoguidance": (int, float),
}
SHOWN: Final = 12  # digits of a fingerprint in messages


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint on disk; its weights are not loaded yet.

    Args:
        folder: the folder of ``persist.json``.
        name: the name of the run or folder, which tables show.
        base_folder: the folder of the backbone's own files.
        backbone: the name of the backbone plugin.
        settings: the plain settings of the backbone.
        fingerprint: a hash of the base's weights.
        adapters: folders of the memory adapters by name.
        default: the name of the adapter to use when a command names none.
        sampling: the default sampling settings of its card, else of its base's; ``None`` when neither has any.
        protocol_sampling: those for a protocol of evaluation, by its name, where they are others.
        training_scenes: the scenes that base and adapters were trained on; ``None`` for cards of earlier versions.
    """

    folder: Path
    name: str
    base_folder: Path
    backbone: str
    settings: dict[str, Any]
    fingerprint: str
    adapters: dict[str, Path]
    default: str | None = None
    sampling: Sampling | None = None
    training_scenes: TrainingScenes | None = None
    protocol_sampling: Mapping[str, Sampling] = dataclasses.field(default_factory=dict)

    def adapter_folder(self, adapter: str) -> Path:
        """Return the folder of an adapter.

        Raises:
            CheckpointError: when there is no such adapter; the message names those that there are.
        """
        if adapter not in self.adapters:
            known = ", ".join(self.adapters) or "no adapter"
            raise CheckpointError(f"{self.folder}: no memory adapter {adapter!r} in it; it has {known}")
        return self.adapters[adapter]

    def check_weights(self, adapter: str | None = None) -> None:
        """Verify the weights of the base, and of an adapter, by ``SHA256SUMS`` where there is one; see ``check_sums``.

        Raises:
            CheckpointError: one line for the first file that is damaged or missing.
        """
        base: Path | dict[str, Any] | None = self.base_folder
        while isinstance(base, Path):
            check_sums(base, lambda name: name.endswith(WEIGHTS) and not name.startswith("adapters/"))
            base = lora_base(base)
        if adapter is not None:
            self.check_adapter(adapter)

    def check_adapter(self, adapter: str) -> None:
        """Verify the weights of an adapter alone, by ``SHA256SUMS`` where there is one; see ``check_sums``.

        Raises:
            CheckpointError: one line for the first file that is damaged or missing.
        """
        folder = self.adapter_folder(adapter)
        within = f"{folder.relative_to(self.folder).as_posix()}/"
        check_sums(self.folder, lambda name: name.endswith(WEIGHTS) and name.startswith(within))

    def sampling_with(self, overrides: SamplingOverrides, protocol: str = "") -> Sampling:
        """Return the card's sampling settings, or else 50 steps of DDIM without guidance, with these overrides.

        Args:
            overrides: settings to use instead.
            protocol: name of a protocol of evaluation, for which the card may have settings of its own.
        """
        default = self.protocol_sampling.get(protocol) or self.sampling or Sampling()
        return dataclasses.replace(default, **overrides.requested())

    def default_adapter(self) -> str | None:
        """Return the name of the card's default or only adapter, ``None`` when there is no adapter.

        Raises:
            CheckpointError: when there are several adapters and no default.
        """
        if self.default in self.adapters:
            return self.default
        if len(self.adapters) > 1:
            raise CheckpointError(f"{self.folder}: choose an adapter of {', '.join(self.adapters)} with --adapter")
        return next(iter(self.adapters), None)

    def chosen_adapter(self, name: str | None) -> str | None:
        """Return the adapter's name that a command means, ``None`` for the model without an adapter.

        Args:
            name: what the command names: an adapter, ``stage1`` for none, or ``None`` for the default.

        Raises:
            CheckpointError: when it names none, and there are several adapters and no default.
        """
        return None if name == PLAIN else name or self.default_adapter()


def find_checkpoint(path: Path) -> Checkpoint:
    """Return the checkpoint in a folder, or the newest one of a run.

    Args:
        path: the folder; ``reference`` and ``reference-1step`` come with the package, unless such folders are here.

    Raises:
        CheckpointError: when there is none, its card is damaged, or its base is missing or has other weights.
    """
    folder = model_folder(checkpoint_folder(path))
    card = read_card(folder)
    base = find_base(folder, card) if card.get("base") else folder
    base_card = read_card(base)
    inherits = not card.get("sampling") and not card.get("protocol_sampling")
    return Checkpoint(
        folder=folder,
        name=run_folder(folder.absolute()).name,
        base_folder=base,
        backbone=base_card["backbone"],
        settings=base_card["settings"],
        fingerprint=str(card.get("fingerprint", "")),
        adapters={path.name: path for path in sorted((folder / "adapters").glob("*")) if path.is_dir()},
        default=base_card.get("default_adapter"),
        sampling=_card_sampling(card, folder / CARD) or _card_sampling(base_card, base / CARD),
        protocol_sampling=_protocol_sampling(*(base_card, base / CARD) if inherits else (card, folder / CARD)),
        training_scenes=_training_scenes(card, folder / CARD),
    )


def checkpoint_folder(path: Path) -> Path:
    """Return the path, or the folder of the packaged model that it names unless such a folder is here.

    Raises:
        CheckpointError: when a packaged model is named and this installation has none.
    """
    return packaged_checkpoint(str(path)) if str(path) in PACKAGED and not path.is_dir() else path


def reference_checkpoint() -> Path:
    """Return the folder of the model that comes with the package, a checkpoint with an adapter for each memory.

    Raises:
        CheckpointError: when this installation does not have it.
    """
    return packaged_checkpoint(REFERENCE)


def packaged_checkpoint(name: str) -> Path:
    """Return the folder of a model of ``PACKAGED``.

    Raises:
        CheckpointError: when this installation does not have it.
    """
    folder = bundled_folder(name)
    if not (folder / CARD).is_file():
        raise CheckpointError(f"no {name} model in {folder}: it comes with the package; give a CHECKPOINT")
    return folder


def base_pointer(card: dict[str, Any]) -> dict[str, Any] | None:
    """Return the part of a card that says which base the checkpoint was trained on; ``None`` when none does.

    Returns:
        A mapping in the card with ``base``, a path relative to the card's folder or a name of ``PACKAGED``, and the
        ``fingerprint`` of that base.
    """
    parts = (card, card.get("changes"), card.get(STARTED_FROM))
    return next((part for part in parts if isinstance(part, dict) and part.get("base")), None)


def find_base(folder: Path, pointer: Mapping[str, Any]) -> Path:
    """Return the folder of the base that a checkpoint was trained on.

    Args:
        folder: the checkpoint's folder.
        pointer: the part of its card that ``base_pointer`` returns. Cards of earlier versions name the base's run, of
            which the checkpoint with the right weights is found.

    Raises:
        CheckpointError: when the base is missing there or has other weights; the message says what to do.
    """
    wanted = str(pointer.get("fingerprint", ""))
    place = (folder / pointer["base"]).resolve()
    if pointer["base"] in PACKAGED and not place.is_dir():
        place = packaged_checkpoint(pointer["base"])
    base = find_weights(place, wanted)
    if base is not None:
        return base
    run, there = run_folder(folder), fingerprints(place)
    if not there:
        raise CheckpointError(
            f"{run}: its base is missing; the checkpoint with fingerprint {wanted[:SHOWN]} was at {place}; "
            f"if it moved: persist relink {quoted(run)} NEW_PLACE"
        )
    raise CheckpointError(
        f"{run}: was trained on another base than the one now at {place}, whose fingerprint is {there[0][:SHOWN]} "
        f"and not {wanted[:SHOWN]}; if its own is elsewhere: persist relink {quoted(run)} PLACE"
    )


def find_weights(place: Path, fingerprint: str) -> Path | None:
    """Return the folder of the base with this fingerprint: the place itself, or among the checkpoints of its run."""
    return next((folder for folder in model_folders(place) if _fingerprint(folder) == fingerprint), None)


def fingerprints(place: Path) -> list[str]:
    """Return the fingerprints of the bases that ``find_weights`` looks through, the place's own or newest first."""
    return [found for found in map(_fingerprint, model_folders(place)) if found]


def lora_base(folder: Path) -> Path | dict[str, Any] | None:
    """Return where the weights are that the LoRA in a base's folder changes, ``None`` for a base without LoRA.

    Returns:
        The folder of another base, or the settings of the backbone that name its pretrained weights.

    Raises:
        CheckpointError: when that base is missing or has other weights.
    """
    changes = read_card(folder).get("changes") if (folder / CARD).is_file() else None
    if changes is None:
        return None
    if "settings" in changes:
        return dict(changes["settings"])
    return find_base(folder, changes)


def step_folders(run: Path) -> list[Path]:
    """Return the folders of a run's complete checkpoints, the newest last."""
    return sorted(folder for folder in run.glob(f"{STEP}*") if folder.is_dir())


def run_folder(folder: Path) -> Path:
    """Return the folder of the run that a checkpoint's folder belongs to, else the folder itself."""
    return folder.parent.parent if folder.parent.name.startswith(STEP) else folder


def model_folder(path: Path) -> Path:
    """Return the folder with the card: the path, ``model`` in a run's ``step-…``, or that of a run's newest checkpoint.

    Raises:
        CheckpointError: when there is none.
    """
    own = _own_folder(path)
    if own is not None:
        return own
    steps = step_folders(path)
    if not steps:
        nearest = None if path.exists() else nearest_name(str(path), PACKAGED)
        meant = f"; did you mean {nearest!r}?" if nearest else ""
        raise CheckpointError(
            f"{path}: no checkpoint there (neither persist.json nor a finetune run's step-* folder){meant}"
        )
    return steps[-1] / "model"


def read_card(folder: Path) -> dict[str, Any]:
    """Return a checkpoint's card; ``CheckpointError`` when it is missing, incomplete or of another version.

    All small files of the folder, the card among them, are verified by ``SHA256SUMS`` where there is one.
    """
    path = folder / CARD
    if (folder / POLICY_CARD).is_file() and not path.is_file():
        raise CheckpointError(f"{run_folder(folder)}: a trained policy, no world model; name it as --policy")
    if (folder / SCENE_CARD).is_file() and not path.is_file():
        raise CheckpointError(f"{run_folder(folder)}: a model of scenes, no world model; a memory 'scene' takes it")
    check_sums(folder, lambda name: not name.endswith(WEIGHTS))
    card = read_json(path)
    if not isinstance(card, dict) or card.get("format") != "persist-checkpoint":
        raise CheckpointError(f"{path}: not the card of a persist checkpoint")
    if card.get("version") != VERSION:
        raise CheckpointError(f"{path}: checkpoint version {card.get('version')}, this persist reads {VERSION}")
    if not card.get("fingerprint") or not (card.get("base") or {"backbone", "settings"} <= set(card)):
        raise CheckpointError(f"{path}: the card is incomplete")
    return card


def model_folders(place: Path) -> list[Path]:
    """Return the place, if it is a checkpoint's folder, and the checkpoints of its run, the newest first."""
    own = _own_folder(place)
    steps = [step / "model" for step in reversed(step_folders(run_folder(own or place)))]
    return steps if own is None else [own, *(step for step in steps if step != own)]


def _own_folder(place: Path) -> Path | None:
    """Return the folder with the card of the place itself, which may be the ``step-…`` folder around it."""
    cards = (CARD, POLICY_CARD, SCENE_CARD)  # the latter two are refused when they are read
    return next(
        (folder for folder in (place, place / "model") if any((folder / card).is_file() for card in cards)), None
    )


def _fingerprint(folder: Path) -> str:
    """Return the fingerprint of the base in a folder, empty where there is none or its card cannot be read."""
    try:
        card = read_card(folder)
    except CheckpointError:
        return ""
    return "" if card.get("base") else str(card["fingerprint"])


def _card_sampling(card: dict[str, Any], path: Path) -> Sampling | None:
    """Return the default sampling settings of a checkpoint's card, ``None`` when it has none."""
    return _sampling(card["sampling"], path) if card.get("sampling") else None


def _protocol_sampling(card: dict[str, Any], path: Path) -> dict[str, Sampling]:
    """Return the sampling settings that a checkpoint's card has for protocols of evaluation, by their names."""
    values = card.get("protocol_sampling") or {}
    if not isinstance(values, dict):
        raise CheckpointError(f"{path}: its protocol_sampling is {values}; it holds sampling settings by protocol")
    return {str(protocol): _sampling(value, path) for protocol, value in values.items()}


def _sampling(value: Any, path: Path) -> Sampling:
    """Return the sampling settings that are JSON values of a card."""
    if not isinstance(value, dict) or any(type(item) not in SAMPLING_TYPES.get(key, ()) for key, item in value.items()):
        raise CheckpointError(
            f"{path}: its sampling is {value}; it may hold {', '.join(SAMPLING_TYPES)}: "
            "numbers, and the name of a sampler"
        )
    sampling = Sampling(**value)
    try:
        sampling.check()
    except PersistError as error:
        raise CheckpointError(f"{path}: its sampling is {value}: {error}") from error
    return sampling


def _training_scenes(card: dict[str, Any], path: Path) -> TrainingScenes | None:
    if "training_scenes" not in card:
        return None
    try:
        return TrainingScenes.from_json(card["training_scenes"])
    except ValueError as error:
        raise CheckpointError(f"{path}: its training scenes cannot be read ({error})") from error
