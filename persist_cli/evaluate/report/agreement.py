"""Whether two runs measured the same, and in what else they differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from persist_cli.evaluate.report.result_file import Clip, ColumnRecord, Evaluation, Measured

MOST = 3  # differences of one sort that are spelled out

DIGEST = 12  # characters shown of a hash


def measured_differently(a: Evaluation, b: Evaluation) -> list[str]:
    """What keeps two runs from being compared, each with both values; nothing when they measured the same."""
    one, two = a.measured, b.measured
    return [
        *_protocol(one, two),
        *_unequal("image size", "×".join(map(str, one.image_size)), "×".join(map(str, two.image_size))),
        *_few(_data(one, two), "trajectories"),
        *_few(_clips(one, two), "clips"),
        *_metrics(one, two),
        *_columns(a.columns, b.columns),
        *_tables(a, b),
    ]


def differing_notes(a: Evaluation, b: Evaluation) -> list[str]:
    """What else differs and may be what one wants to compare: sampling, versions, checkpoints, rows and columns."""
    first, second = {each.name: each for each in a.checkpoints}, {each.name: each for each in b.checkpoints}
    prints = [
        line
        for name in first
        if name in second
        for line in _unequal(f"checkpoint {name}", first[name].fingerprint[:DIGEST], second[name].fingerprint[:DIGEST])
    ]
    rows, others = _definitions(a), _definitions(b)
    return [
        *_unequal_items("", a.sampling.model_dump(exclude={"batch"}), b.sampling.model_dump(exclude={"batch"})),
        *_unequal_items("", _versions(a), _versions(b)),
        *_unequal("checkpoints", ", ".join(first) or "none", ", ".join(second) or "none"),
        *prints,
        *_one_sided("column", a.columns, b.columns),
        *_one_sided("row", rows, others),
        *_unequal_items("row ", {name: text for name, text in rows.items() if name in others},
                        {name: text for name, text in others.items() if name in rows}),
    ]  # fmt: skip


def _protocol(one: Measured, two: Measured) -> list[str]:
    p, q = one.protocol, two.protocol
    if p.name != q.name:
        return _unequal("protocol", p.name, q.name)
    return [
        *_unequal(f"definition of the protocol {p.name}", p.definition, q.definition),
        *_unequal("frames a clip", p.frames, q.frames),
    ]


def _data(one: Measured, two: Measured) -> Iterator[str]:
    for number, (first, second) in enumerate(zip(one.data, two.data, strict=False)):
        hashes, others = first.trajectories, second.trajectories
        for name in [*hashes, *(name for name in others if name not in hashes)]:
            yield from _unequal(
                f"trajectory {name} of data set {number}", _digest(hashes.get(name)), _digest(others.get(name))
            )
    yield from _unequal("number of data sets", len(one.data), len(two.data))


def _clips(one: Measured, two: Measured) -> Iterator[str]:
    yield from _unequal("number of clips", len(one.clips), len(two.clips))
    for number, (first, second) in enumerate(zip(one.clips, two.clips, strict=False)):
        yield from _unequal(f"clip {number}", _clip_name(first), _clip_name(second))


def _clip_name(clip: Clip) -> str:
    return f"{clip.data}/{clip.trajectory}:{clip.start}+{clip.frames}"


def _metrics(one: Measured, two: Measured) -> Iterator[str]:
    for name, metric in one.metrics.items():
        if name in two.metrics:
            other = two.metrics[name]
            yield from _unequal(f"definition of {metric.title}", metric.definition, other.definition)
            for weight in sorted({*metric.weights, *other.weights}):
                digests = (_digest(each.weights.get(weight)) for each in (metric, other))
                yield from _unequal(f"weights {weight} of {metric.title}", *digests)


def _columns(one: Mapping[str, ColumnRecord], two: Mapping[str, ColumnRecord]) -> Iterator[str]:
    for name, column in one.items():
        if name in two:
            for key in ("metric", "frames", "better", "definition"):
                yield from _unequal(f"{key} of column {name}", getattr(column, key), getattr(two[name], key))


def _tables(a: Evaluation, b: Evaluation) -> Iterator[str]:
    """Tables are told by their clips: their names may hold where the data lay."""
    yield from _unequal("number of tables", len(a.tables), len(b.tables))
    for one, two in zip(a.tables, b.tables, strict=False):
        if one.clips != two.clips:
            yield f"clips of a table: {len(one.clips)} in {one.name} and {len(two.clips)} in {two.name}, not the same"


def _definitions(results: Evaluation) -> dict[str, str]:
    return {name: row.definition for table in results.tables for name, row in table.rows.items()}


def _versions(results: Evaluation) -> dict[str, Any]:
    flat = {key: value for key, value in results.environment.items() if not isinstance(value, Mapping)}
    for value in results.environment.values():
        flat |= value if isinstance(value, Mapping) else {}
    return flat


def _unequal(what: str, one: object, two: object) -> list[str]:
    return [] if one == two else [f"{what}: {_shown(one)} and {_shown(two)}"]


def _unequal_items(prefix: str, one: Mapping[str, Any], two: Mapping[str, Any]) -> list[str]:
    names = [*one, *(name for name in two if name not in one)]
    return [line for name in names for line in _unequal(prefix + name, one.get(name), two.get(name))]


def _one_sided(what: str, one: Mapping[str, Any], two: Mapping[str, Any]) -> list[str]:
    sides = (("A", one, two), ("B", two, one))
    return [f"{what} {name}: only in {side}" for side, mine, other in sides for name in mine if name not in other]


def _few(lines: Iterator[str], what: str) -> Sequence[str]:
    every = list(lines)
    return every if len(every) <= MOST else [*every[:MOST], f"{len(every) - MOST} more {what}"]


def _digest(value: str | None) -> str | None:
    return value[:DIGEST] if value else None


def _shown(value: object) -> str:
    return "none" if value is None else " ".join(str(value).split()) or "nothing"
