"""What a folder was begun with: what goes on in it is the same work, and other work is refused."""

from __future__ import annotations

from typing import Any, Final

from persist_cli.errors import PersistError

# keys that earlier versions did not write, with the values that they stood for; None: they looked at no such thing
ADDED: Final = {"adapter_settings": None, "adapter_code": None, "code": None, "autoguidance": (None, 1.0)}
MISSING: Final = object()  # equals no value, as None would


def check_same(earlier: Any, now: Any, refusal: str) -> None:
    """Raise ``PersistError`` when a folder was begun with other values than those of now.

    A checkpoint that was moved is the same one: where a fingerprint stands, the path beside it does not count. What an
    earlier version did not write is not compared.

    Args:
        earlier: JSON values that the folder holds.
        now: JSON values.
        refusal: the beginning of the error's line.
    """
    earlier, now = _wherever_it_lies(earlier), _wherever_it_lies(now)
    now = _as_earlier(earlier, now)
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


def _as_earlier(earlier: Any, now: Any) -> Any:
    """Return the values of now without what an earlier version of persist did not write yet."""
    if isinstance(earlier, dict) and isinstance(now, dict):
        added = {key for key in ADDED.keys() & {*now} - {*earlier} if _stands_for_none(key, now[key])}
        return {key: _as_earlier(earlier.get(key), value) for key, value in now.items() if key not in added}
    if isinstance(earlier, list) and isinstance(now, list) and len(earlier) == len(now):
        return [_as_earlier(*pair) for pair in zip(earlier, now, strict=True)]
    return now


def _stands_for_none(key: str, value: Any) -> bool:
    """Whether a key that was added says nothing that an earlier version had not done without it."""
    unsaid = ADDED[key]
    return unsaid is None or value in unsaid


def first_difference(earlier: Any, new: Any, where: str = "") -> str:
    """The first key that two plans differ in, with both values."""
    if isinstance(earlier, dict) and isinstance(new, dict):
        key = next(key for key in sorted({*earlier, *new}) if earlier.get(key, MISSING) != new.get(key, MISSING))
        return first_difference(earlier.get(key), new.get(key), f"{where} {key}".strip())
    pairs = list(zip(earlier, new, strict=False)) if isinstance(earlier, list) and isinstance(new, list) else []
    if pairs and isinstance(pairs[0][0], dict) and len(earlier) == len(new):
        place = next(place for place, (one, two) in enumerate(pairs) if one != two)
        return first_difference(*pairs[place], f"{where} {place}")
    return f"{where}: {earlier}, now {new}"
