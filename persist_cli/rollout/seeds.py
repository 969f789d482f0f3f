"""Seeds of the sampling noise of clips."""

from __future__ import annotations

from typing import Final

import numpy as np

from persist_cli.errors import PersistError

SEEDS: Final = 2**31  # of the sampling noise of an agent
CLIPS: Final = 1_000_000  # more than a rollout has


def clip_seed(seed: int, clip: int) -> int:
    """Return the seed of a clip of a rollout, as ``nth_seed`` makes it."""
    if not 0 <= seed < SEEDS or clip >= CLIPS:
        raise PersistError(f"seed {seed} must be 0 to {SEEDS - 1}, and a rollout has at most a million clips")
    return nth_seed(seed, clip, CLIPS)


def nth_seed(seed: int, number: int, most: int) -> int:
    """Return another seed for each seed and each number below ``most``, of 32 bits.

    Generators of the CPU take no more. Where the two do not fit it is a hash of them, and equal ones are rare.
    """
    distinct = seed * most + number
    return distinct if distinct < 2**32 else int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
