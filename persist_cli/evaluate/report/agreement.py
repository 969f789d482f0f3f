"""Agreement of two runs: whether they measured the same clips and metrics, and in what else they differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from persist_cli.evaluate.report.result_file import ClipRecord, ColumnRecord, EvalResults, Measured

MOST_LINES = 3  # for differences of one sort; the rest is counted

DIGEST_LENGTH = 12  # characters shown of a hash


def measured_differently(a: EvalResults, b: EvalResults) -> list[str]:
    """Reasons why two runs cannot be compared, with both values; empty when they measured the same."""
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


def differing_notes(a: EvalResults, b: EvalResults) -> list[str]:
    """Differences that one may want to compare: sampling, versions, checkpoints, rows and columns."""
    prints_a, prints_b = _fingerprints(a), _fingerprints(b)
    rows_a, rows_b = _definitions(a), _definitions(b)
    return [
        *_unequal_items("", _sampling(a), _sampling(b)),
        *_unequal_items("", _versions(a), _versions(b)),
        *_unequal("checkpoints", ", ".join(prints_a) or "none", ", ".join(prints_b) or "none"),
        *_unequal_items("checkpoint ", prints_a, prints_b, common=True),
        *_clip_weights(a, b),
        *_one_sided("column", a.columns, b.columns),
        *_one_sided("row", rows_a, rows_b),
        *_unequal_items("row ", rows_a, rows_b, common=True),
    ]


def _protocol(one: Measured, two: Measured) -> list[str]:
    first, second = one.protocol, two.protocol
    if first.name != second.name:
        return _unequal("protocol", first.name, second.name)
    return [
        *_unequal(f"definition of the protocol {first.name}", first.definition, second.definition),
        *_unequal("frames a clip", first.frames, second.frames),
    ]


def _data(one: Measured, two: Measured) -> Iterator[str]:
    for number, (first, second) in enumerate(zip(one.data, two.data, strict=False)):
        for name in first.trajectories | second.trajectories:
            digests = (_digest(data.trajectories.get(name)) for data in (first, second))
            yield from _unequal(f"trajectory {name} of data set {number}", *digests)
    yield from _unequal("number of data sets", len(one.data), len(two.data))


def _clips(one: Measured, two: Measured) -> Iterator[str]:
    yield from _unequal("number of clips", len(one.clips), len(two.clips))
    for number, (first, second) in enumerate(zip(one.clips, two.clips, strict=False)):
        names = _clip_name(first), _clip_name(second)
        yield from _unequal(f"clip {number}", *names) or _frames(number, first, second)


def _frames(number: int, one: ClipRecord, two: ClipRecord) -> list[str]:
    """The first frame of a clip that counts, or returns to an earlier one, in one run alone; one line at most.

    Which do depends on how many frames are predicted at once, where the model's own frames go into the memory.
    """
    for frame, counts in enumerate(zip(one.counted, two.counted, strict=False)):
        if counts[0] != counts[1]:
            return [f"clip {number}: frame {frame} counts in {'A' if counts[0] else 'B'} only"]
    for frame, visits in enumerate(zip(one.first_visits, two.first_visits, strict=False)):
        if visits[0] != visits[1]:
            earlier = ["no earlier frame" if visit < 0 else f"frame {visit}" for visit in visits]
            return [f"clip {number}: frame {frame} returns to {earlier[0]} in A and {earlier[1]} in B"]
    return []


def _clip_name(clip: ClipRecord) -> str:
    return f"{clip.data}/{clip.trajectory}:{clip.start}+{clip.frames}"


def _metrics(one: Measured, two: Measured) -> Iterator[str]:
    for name, metric in one.metrics.items():
        if name in two.metrics:
            metrics = (metric, two.metrics[name])
            yield from _unequal(f"definition of {metric.title}", *(metric.definition for metric in metrics))
            for weight in sorted(set(metrics[0].weights) & set(metrics[1].weights)):  # else one run has no figure
                digests = (_digest(metric.weights[weight]) for metric in metrics)
                yield from _unequal(f"weights {weight} of {metric.title}", *digests)


def _columns(one: Mapping[str, ColumnRecord], two: Mapping[str, ColumnRecord]) -> Iterator[str]:
    for name, column in one.items():
        if name in two:
            for key in ("metric", "frames", "better", "definition"):
                yield from _unequal(f"{key} of column {name}", getattr(column, key), getattr(two[name], key))


def _tables(a: EvalResults, b: EvalResults) -> Iterator[str]:
    """Tables are compared by their clips, because their names may hold the folder of the data."""
    yield from _unequal("number of tables", len(a.tables), len(b.tables))
    for one, two in zip(a.tables, b.tables, strict=False):
        if one.clips != two.clips:
            yield f"clips of a table: {len(one.clips)} in {one.name} and {len(two.clips)} in {two.name}, not the same"


def _clip_weights(a: EvalResults, b: EvalResults) -> list[str]:
    """A line for each column whose clips are weighted in one run alone: an earlier version counted all the same."""
    one, two = (_weighted_columns(results) for results in (a, b))
    return [
        f"clips of {a.columns[name].title} are weighted in {'A' if one[name] else 'B'} only, so it has no difference: "
        f"evaluate {'B' if one[name] else 'A'} again in its folder"
        for name in one
        if name in two and one[name] != two[name]
    ]


def _weighted_columns(results: EvalResults) -> dict[str, bool]:
    """Whether the clips of each column that has figures of single clips are weighted."""
    weighted: dict[str, bool] = {}
    for name, cell in (item for table in results.tables for row in table.rows.values() for item in row.columns.items()):
        if cell.per_clip is not None:
            weighted[name] = weighted.get(name, False) or cell.clip_weights is not None
    return weighted


def _fingerprints(results: EvalResults) -> dict[str, str]:
    return {checkpoint.name: checkpoint.fingerprint[:DIGEST_LENGTH] for checkpoint in results.checkpoints}


def _sampling(results: EvalResults) -> dict[str, Any]:
    """The sampling of all rows; where some have one of their own, their definitions say it."""
    return results.sampling.model_dump(exclude={"batch", "sampling_of"})


def _definitions(results: EvalResults) -> dict[str, str]:
    return {name: row.definition for table in results.tables for name, row in table.rows.items()}


def _versions(results: EvalResults) -> dict[str, Any]:
    versions = {key: value for key, value in results.environment.items() if not isinstance(value, Mapping)}
    for value in results.environment.values():
        versions |= value if isinstance(value, Mapping) else {}
    return versions


def _unequal(what: str, one: object, two: object) -> list[str]:
    return [] if one == two else [f"{what}: {_shown(one)} and {_shown(two)}"]


def _unequal_items(prefix: str, one: Mapping[str, Any], two: Mapping[str, Any], common: bool = False) -> list[str]:
    """A line for each item that differs; with ``common`` only of those that both have."""
    names = [name for name in {**one, **two} if not common or (name in one and name in two)]
    return [line for name in names for line in _unequal(prefix + name, one.get(name), two.get(name))]


def _one_sided(what: str, one: Mapping[str, Any], two: Mapping[str, Any]) -> list[str]:
    sides = (("A", one, two), ("B", two, one))
    return [f"{what} {name}: only in {side}" for side, own, other in sides for name in own if name not in other]


def _few(lines: Iterator[str], what: str) -> Sequence[str]:
    all_lines = list(lines)
    more = len(all_lines) - MOST_LINES
    return all_lines if more <= 0 else [*all_lines[:MOST_LINES], f"{more} more {what}"]


def _digest(value: str | None) -> str | None:
    return value[:DIGEST_LENGTH] if value else None


def _shown(value: object) -> str:
    return "none" if value is None else " ".join(str(value).split()) or "nothing"
