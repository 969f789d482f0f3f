"""What a folder was begun with: what goes on in it is the same work, and other work is refused."""

from __future__ import annotations

from typing import Any

from persist_cli.errors import PersistError


def check_same(earlier: Any, now: Any, refusal: str) -> None:
    """Raise ``PersistError`` when a folder was begun with other values than those of now.

    A checkpoint that was moved is the same one: where a fingerprint stands, the path beside it does not count.

    Args:
        earlier: JSON values that the folder holds.
        now: JSON values.
        refusal: the beginning of the error's line.
    """
    earlier, now = _wherever_it_lies(earlier), _wherever_it_lies(now)
    if earlier != now:
        raise PersistError(f"{refusal} ({first_difference(earlier, now)}); choose another --out or delete it")


def _wherever_it_lies(values: Any) -> Any:
    """Return JSON values without the paths of what a fingerprint names."""
    if isinstance(values, dict):
        return {
            key: _wherever_it_lies(value)
            for key, value in values.items()
            if not (key == "path" and "fingerprint" in values)
        }
    return [_wherever_it_lies(value) for value in values] if isinstance(values, list) else values


def first_difference(earlier: Any, new: Any, where: str = "") -> str:
    """The first key that two plans differ in, with both values."""
    if isinstance(earlier, dict) and isinstance(new, dict):
        key = next(key for key in sorted({*earlier, *new}) if earlier.get(key) != new.get(key))
        return first_difference(earlier.get(key), new.get(key), f"{where} {key}".strip())
    pairs = list(zip(earlier, new, strict=False)) if isinstance(earlier, list) and isinstance(new, list) else []
    if pairs and isinstance(pairs[0][0], dict) and len(earlier) == len(new):
        place = next(place for place, (one, two) in enumerate(pairs) if one != two)
        return first_difference(*pairs[place], f"{where} {place}")
    return f"{where}: {earlier}, now {new}"
