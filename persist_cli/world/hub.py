"""Whether the Hugging Face hub can be asked at all, found out in seconds rather than by its client's retries."""

from __future__ import annotations

import functools
import ssl
from typing import Final

PATIENCE: Final = 3.0  # seconds
MODEL_FILES: Final = ("config.json", "model.safetensors")


def hub_obstacle() -> str | None:
    """Why the hub is out of reach, in a few words; ``None`` when it answers. The network is asked once a process."""
    from huggingface_hub import constants

    return "HF_HUB_OFFLINE is set" if constants.HF_HUB_OFFLINE else _silence(constants.ENDPOINT)


def in_hub_cache(repository: str) -> bool:
    """Whether the hub's own cache has a model's configuration and weights, so that no network is needed."""
    from huggingface_hub import try_to_load_from_cache

    return all(isinstance(try_to_load_from_cache(repository, name), str) for name in MODEL_FILES)


@functools.cache
def _silence(endpoint: str) -> str | None:
    import http.client
    import urllib.error
    import urllib.request

    try:
        urllib.request.urlopen(urllib.request.Request(endpoint, method="HEAD"), timeout=PATIENCE).close()
    except urllib.error.HTTPError:
        return None  # something answers: what it thinks of the request is for the hub's client to find out
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", error)
        if isinstance(reason, ssl.SSLError):
            return None  # the client has certificates of its own
        return f"{endpoint} does not answer ({reason})"
    return None
