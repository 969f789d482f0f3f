"""Where pretrained weights are: a local diffusers directory, or a repository of the hub by its name."""

from __future__ import annotations

import re
from pathlib import Path

from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import read_json
from persist_cli.world.hub import hub_obstacle

PARTS = ("transformer", "vae", "scheduler")
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
WEIGHTS = "diffusion_pytorch_model.safetensors"  # of a part that is not split into several files
PUBLISHED = {  # what the repositories of THUDM, now zai-org, hold
    "CogVideoX-2b": "2b",
    "CogVideoX-5b": "5b",
    "CogVideoX-5b-I2V": "5b-i2v",
    "CogVideoX1.5-5B": "1.5-5b",
    "CogVideoX1.5-5B-I2V": "1.5-5b-i2v",
}


def published_preset(name: str) -> str | None:
    """The preset that has the sizes of a published model's repository, ``None`` for any other name."""
    owner, _, model = name.partition("/")
    return PUBLISHED.get(model) if owner in ("THUDM", "zai-org") else None


def origin_of(pretrained: str | None) -> dict[str, str]:
    """The setting that finds pretrained weights from wherever one stands; none for none."""
    if not pretrained:
        return {}
    return {"pretrained": str(Path(pretrained).resolve()) if Path(pretrained).is_dir() else pretrained}


def folder_here(name: str) -> Path | None:
    """The local directory of this name, else what the hub's cache has of a repository; ``None`` when there is neither.

    The network is not asked.
    """
    from huggingface_hub import errors, snapshot_download

    folder = Path(name).expanduser()
    if folder.is_dir():
        return folder
    if not REPOSITORY.fullmatch(name):
        return None
    try:
        return Path(snapshot_download(name, local_files_only=True))
    except errors.LocalEntryNotFoundError:
        return None


def check_name(name: str) -> None:
    """Raise ``CheckpointError`` for what is no local directory and cannot be a repository of the hub either."""
    if not REPOSITORY.fullmatch(name):
        raise CheckpointError(f"{name}: no such directory, and not the name of a repository on the hub (owner/model)")


def pretrained_folder(name: str) -> Path:
    """The local directory of this name, else that of a repository of the hub in its cache.

    What the cache lacks of transformer, VAE and scheduler is downloaded; a text encoder never is.

    Raises:
        CheckpointError: one line when there is no such directory, and the repository cannot be had either.
    """
    folder = folder_here(name)
    if folder is not None and (not _of_the_hub(name) or not any(missing_files(folder / part) for part in PARTS)):
        return folder
    check_name(name)
    obstacle = hub_obstacle()
    if obstacle:
        parts = " ".join(f"'{part}/*'" for part in PARTS)
        raise CheckpointError(
            f"{name}: no such directory, not whole in the hub's cache, and the hub: {obstacle}; give a local diffusers "
            f"directory, or fetch it elsewhere: hf download {name} --include {parts}"
        )
    return _download(name)


def _of_the_hub(name: str) -> bool:
    return not Path(name).expanduser().is_dir()


def _download(name: str) -> Path:
    from huggingface_hub import errors, snapshot_download

    wanted = [f"{part}/*.{kind}" for part in PARTS for kind in ("json", "safetensors")]
    try:
        return Path(snapshot_download(name, allow_patterns=wanted))
    except (OSError, ValueError, errors.HfHubHTTPError) as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{name}: the hub does not give it ({cause})") from error


def missing_files(part: Path) -> list[str]:
    """Names of the configuration and of the weights that a part's folder ought to have and has not."""
    if part.name == "scheduler":
        wanted = ["scheduler_config.json"]
    else:
        index = part / "diffusion_pytorch_model.safetensors.index.json"
        weights = set(read_json(index)["weight_map"].values()) if index.is_file() else {WEIGHTS}
        wanted = ["config.json", *sorted(weights)]
    return [name for name in wanted if not (part / name).is_file()]
