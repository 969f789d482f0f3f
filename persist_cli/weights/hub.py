"""Weights from the Hugging Face hub, or from what it left in its own cache; quick to say that it is out of reach."""

from __future__ import annotations

from pathlib import Path

from persist_cli.weights.catalog import HubRepository
from persist_cli.weights.package_index import SourceError
from persist_cli.world.hub import MODEL_FILES, hub_obstacle


def hub_files(repository: HubRepository, offline: bool) -> dict[str, Path]:
    """Where the hub's cache has ``MODEL_FILES`` of the pinned commit, after downloading what it lacks.

    Raises:
        SourceError: when they are not there and cannot be had.
    """
    from huggingface_hub import try_to_load_from_cache

    cached = {name: try_to_load_from_cache(repository.name, name, revision=repository.revision) for name in MODEL_FILES}
    found = {name: Path(path) for name, path in cached.items() if isinstance(path, str)}
    if len(found) == len(MODEL_FILES):
        return found
    obstacle = "not asked" if offline else hub_obstacle()
    if obstacle:
        raise SourceError(f"hub {repository.name}: {obstacle}")
    return {name: _download(repository, name) for name in MODEL_FILES}


def _download(repository: HubRepository, name: str) -> Path:
    from huggingface_hub import errors, hf_hub_download

    failures = (OSError, ValueError, errors.EntryNotFoundError, errors.HTTPError)  # type: ignore[attr-defined]
    try:
        return Path(hf_hub_download(repository.name, name, revision=repository.revision, etag_timeout=5))
    except failures as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise SourceError(f"hub {repository.name}: {cause}") from error
