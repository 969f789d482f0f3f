"""How edits are written: on the command line, as in ``--move table#1 0.5,0,0``, and in JSON files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from pydantic import TypeAdapter, ValidationError

from persist_cli.api.cells import Box
from persist_cli.api.scene_edits import Copy, Edit, Insert, Move, Paint, Remove
from persist_cli.errors import DataError, hint
from persist_cli.io.files import write_json

OPEN: Final = "_"  # stands for the height of a thing that rests on what is there
POINT: Final = "three numbers of metres, as in 1.5,0,-0.75"


class WrittenEdit(NamedTuple):
    """An option of the command line with its values, as in ``("paint", ("table#1", "red"))``."""

    option: str
    values: tuple[str, ...]


def make_edits(written: Sequence[WrittenEdit], things: Mapping[str, Box] | None, overwrite: bool) -> list[Edit]:
    """Return the edits of a command line in its order.

    Args:
        written: the options; one of ``edits`` stands for all edits of a JSON file.
        things: boxes of the things that can be named; ``None`` where boxes alone can be written.
        overwrite: whether what is moved, copied or inserted may take the place of something.

    Raises:
        DataError: one line that names the option and the text that cannot be read.
    """
    edits: list[Edit] = []
    for option, values in written:
        if option == "edits":
            edits += [_overwriting(edit) if overwrite else edit for edit in read_edits(Path(values[0]))]
        else:
            edits.append(_make_edit(option, values, things, overwrite))
    return edits


def _overwriting(edit: Edit) -> Edit:
    """Return an edit of a file with the command line's ``--overwrite``."""
    return edit.model_copy(update={"overwrite": True}) if isinstance(edit, Insert | Move | Copy) else edit


def _make_edit(option: str, values: Sequence[str], things: Mapping[str, Box] | None, overwrite: bool) -> Edit:
    first, second = values[0], values[-1]
    try:
        if option == "insert":
            return Insert(kind=first, at=parse_place(second), overwrite=overwrite)
        box = parse_box(first, things)
        if option == "remove":
            return Remove(low=box.low, high=box.high)
        if option == "paint":
            return Paint(low=box.low, high=box.high, color=parse_color(second))
        kind = Move if option == "move" else Copy
        return kind(low=box.low, high=box.high, by=parse_point(second), overwrite=overwrite)
    except DataError as error:
        raise DataError(f"--{option} {' '.join(values)}: {error}") from error


def parse_box(text: str, things: Mapping[str, Box] | None) -> Box:
    """Return the box of ``x,y,z:x,y,z``, whose corners may come in any order, or of a thing such as ``table#1``.

    Raises:
        DataError: when it is neither.
    """
    if ":" in text:
        corners = [parse_point(part) for part in text.split(":", 1)]
        x, y, z = (sorted(pair) for pair in zip(*corners, strict=True))
        return Box((x[0], y[0], z[0]), (x[1], y[1], z[1]))
    if things is not None and text in things:
        return things[text]
    known = "this memory has no things with names" if things is None else hint(text, things, "there are")
    raise DataError(f"{text!r} is no box x,y,z:x,y,z in metres, nor a thing: {known}")


def parse_point(text: str) -> tuple[float, float, float]:
    """Return the coordinates of ``x,y,z``.

    Raises:
        DataError: when it is not of this form.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise DataError(f"{text!r} is not {POINT}") from error
    if not all(map(math.isfinite, (x, y, z))):
        raise DataError(f"{text!r} is not {POINT}")
    return x, y, z


def parse_place(text: str) -> tuple[float | None, float | None, float | None]:
    """Return the coordinates of ``x,y,z``, ``None`` for one that is left open by ``_``."""
    open_at = [part.strip() == OPEN for part in text.split(",")]
    x, y, z = parse_point(",".join("0" if left else part for part, left in zip(text.split(","), open_at, strict=True)))
    first, second, third = (None if left else value for value, left in zip((x, y, z), open_at, strict=True))
    return first, second, third


def parse_color(text: str) -> tuple[int, int, int]:
    """Return RGB of ``#rrggbb`` or of a colour's name, as ``orange``.

    Raises:
        DataError: when there is no such colour.
    """
    from PIL import ImageColor

    try:
        red, green, blue = ImageColor.getrgb(text)[:3]
        if max(red, green, blue) > 255:
            raise ValueError
    except ValueError as error:
        raise DataError(f"{text!r} is no colour #rrggbb, nor the name of one; {_color_hint(text)}") from error
    return red, green, blue


def _color_hint(text: str) -> str:
    from PIL import ImageColor

    return hint(text, ImageColor.colormap) if text.isalpha() else "for example #ff8000 or orange"


def read_edits(path: Path) -> list[Edit]:
    """Return the edits of a JSON file, which ``write_edits`` writes.

    Raises:
        DataError: one line that names the file, the edit and what is wrong with it.
    """
    adapter: TypeAdapter[list[Edit]] = TypeAdapter(list[Edit])
    try:
        return adapter.validate_json(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); --save-edits writes such a file") from error
    except ValidationError as error:
        raise DataError(f"{path}: {_first_fault(error)}") from error


def _first_fault(error: ValidationError) -> str:
    """Return what is wrong with the first wrong edit."""
    fault = error.errors(include_url=False)[0]
    number, *field = fault["loc"] or ("",)
    where = f"edit {number + 1}: " if isinstance(number, int) else ""
    name = ".".join(str(part) for part in field[1:])
    return f"{where}{name + ': ' if name else ''}{fault['msg']}"


def write_edits(path: Path, edits: Sequence[Edit]) -> None:
    """Write edits as a JSON file, whole or not at all."""
    write_json(path, edits_json(edits))


def edits_json(edits: Sequence[Edit]) -> list[dict[str, Any]]:
    """Return edits as values of JSON."""
    return [edit.model_dump(mode="json") for edit in edits]
