"""The results of ``persist eval`` as its JSON holds them, checked."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from persist_cli.errors import DataError

FORMAT = "persist-evaluation"

VERSION = 1

FILE = "results.json"  # in a report's folder

FILES = (FILE, "metrics.json")  # that one, or the one in the folder of ``persist eval --out``

Kind = Literal["model", "control", "memory control"]


def _defined(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


Figure = Annotated[float | None, BeforeValidator(_defined)]


class ResultModel(BaseModel):
    """A part of the results; keys that are not known here are kept out, so that later minor additions still read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Protocol(ResultModel):
    """Which clips were asked of the model, and how."""

    name: str
    title: str = ""
    definition: str = ""
    frames: int


class DataSet(ResultModel):
    """A data set with the hash of each trajectory that was used."""

    path: str
    trajectories: dict[str, str]


class Clip(ResultModel):
    """One measured clip; ``data`` is the number of its data set, ``seen_before`` a share for each frame."""

    data: int
    trajectory: str
    scene: str | int | None = None
    start: int
    frames: int
    seen_before: list[Figure] = []
    path_metres: Figure = None
    farthest_metres: Figure = None
    turned_degrees: Figure = None


class MetricFacts(ResultModel):
    """What a metric is, with the hash of each weight it used."""

    title: str
    better: str | None = None
    definition: str
    weights: dict[str, str] = {}


class Measured(ResultModel):
    """Everything that two runs must share to be comparable."""

    protocol: Protocol
    data: list[DataSet]
    image_size: tuple[int, int]
    clips: list[Clip]
    metrics: dict[str, MetricFacts]


class ColumnRecord(ResultModel):
    """A column of the table: a metric over all frames, the last one, the returns, or the views that are new."""

    metric: str
    title: str
    better: str | None = None
    definition: str = ""
    frames: str = "all"


class Difference(ResultModel):
    """Paired difference to another row with its 95 % interval."""

    mean: Figure
    low: Figure = None
    high: Figure = None

    @property
    def clear(self) -> bool:
        """Whether the interval is known and leaves zero out."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


class Cell(ResultModel):
    """A figure with its spread, or why there is none."""

    na: str | None = None
    mean: Figure = None
    std: Figure = None
    low: Figure = None
    high: Figure = None
    count: int | None = None
    per_clip: list[Figure] | None = None
    difference: Difference | None = None
    differences: dict[str, Difference | None] = {}


class Bin(ResultModel):
    """Frames whose view was seen before to a share from ``low`` to ``high``."""

    low: float
    high: float
    mean: Figure
    count: int


class Curve(ResultModel):
    """A metric frame by frame, the last value at the clip's last frame, and by the seen-before share of the view."""

    per_frame: list[Figure] = []
    by_seen_before: list[Bin] = []


class Row(ResultModel):
    """A row of the table."""

    kind: Kind
    definition: str = ""
    checkpoint: str | None = None
    memory: str | None = None
    columns: dict[str, Cell]
    curves: dict[str, Curve] = {}


class Table(ResultModel):
    """A table over some of the clips."""

    name: str
    clips: list[int]
    rows: dict[str, Row]


class KnownScenes(ResultModel):
    """How many scenes a checkpoint is known to have been trained on, and whether these are all."""

    known: int
    complete: bool


class CheckpointFacts(ResultModel):
    """A checkpoint by what is in it."""

    name: str
    path: str = ""
    fingerprint: str = ""
    recipe_sha256: str | None = None
    training_scenes: KnownScenes | None = None
    adapters: dict[str, str] = {}


class SamplingRecord(ResultModel):
    """How clips were drawn from the models."""

    steps: int | None = None
    sampler: str | None = None
    memory_guidance: float | None = None
    dtype: str | None = None
    tiling: bool = False
    seeds: list[int] = []
    batch: int | None = None


class Evaluation(ResultModel):
    """All results of one ``persist eval``."""

    measured: Measured
    sampling: SamplingRecord
    environment: dict[str, Any] = {}
    command: list[str] = []
    checkpoints: list[CheckpointFacts] = []
    columns: dict[str, ColumnRecord]
    tables: list[Table]
    first_row: str | None = None


def read_results(path: Path) -> Evaluation:
    """Results from a JSON file, or from the folder of an evaluation or a report.

    Raises:
        DataError: one line when it is missing, not JSON, not results, or of another version.
    """
    file = path
    if path.is_dir():
        file = next((path / name for name in FILES if (path / name).is_file()), path / FILE)
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{file}: no such file; `persist eval` writes it") from error
    except (ValueError, OSError, RecursionError) as error:
        raise DataError(f"{file}: not readable as JSON ({str(error).splitlines()[0]})") from error
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise DataError(f"{file}: not the results of `persist eval` (no format {FORMAT!r} in it)")
    if value.get("version") != VERSION:
        raise DataError(f"{file}: results of version {value.get('version')!r}; this persist reads version {VERSION}")
    return check_results(value, str(file))


def check_results(value: Mapping[str, Any], where: str) -> Evaluation:
    """Results from JSON values; ``DataError`` names ``where`` and the first key that does not fit."""
    try:
        results = Evaluation.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        raise DataError(f"{where}: results are damaged: {key}: {first['msg']}") from error
    for table in results.tables:
        if not all(0 <= number < len(results.measured.clips) for number in table.clips):
            raise DataError(f"{where}: results are damaged: table {table.name!r} names clips that are not there")
        for name, row in table.rows.items():
            for column, cell in row.columns.items():
                if cell.per_clip is not None and len(cell.per_clip) != len(table.clips):
                    raise DataError(
                        f"{where}: results are damaged: {table.name}, {name}, {column} has {len(cell.per_clip)} "
                        f"figures for {len(table.clips)} clips"
                    )
    return results


ARROWS = {"higher": "↑", "lower": "↓"}

UNDEFINED = "–"  # a figure that was measured and has no value

MARK = "*"  # behind a difference whose interval leaves zero out

MORE_DIGITS = 3  # for a clear difference that would read as zero


def digits_of(values: Iterable[float | None]) -> int:
    """Decimals that show about four figures of a usual value of a column; an outlier changes nothing."""
    sizes = sorted(abs(value) for value in values if value)
    usual = sizes[(len(sizes) - 1) // 2] if sizes else 0.0
    for digits, least in enumerate((100.0, 10.0, 0.1, 0.01), start=1):
        if usual >= least:
            return digits
    return 5 if usual else 2


def number(value: float | None, digits: int, signed: bool = False) -> str:
    """A number with a true minus sign; a value that rounds to zero has no sign."""
    if value is None:
        return UNDEFINED
    if not round(value, digits):
        value = 0.0
    return f"{value:{'+' if signed and value else ''}.{digits}f}".replace("-", "−")


def spread_text(cell: Cell, digits: int) -> str:
    """``mean ± std``; the mean alone where there is one seed or nothing random."""
    mean = number(cell.mean, digits)
    return mean if cell.std is None or cell.mean is None else f"{mean} ± {number(cell.std, digits)}"


def interval_text(low: float | None, high: float | None, digits: int, signed: bool = False) -> str:
    """``[low, high]``; empty when there is none."""
    if low is None or high is None:
        return ""
    return f"[{number(low, digits, signed)}, {number(high, digits, signed)}]"


def difference_texts(difference: Difference, digits: int) -> tuple[str, str]:
    """The signed difference, marked when its interval leaves zero out, and that interval.

    A clear difference too small for the column's digits gets up to three more; below that it is zero, unmarked.
    """
    mean = difference.mean
    if mean is not None and difference.clear:
        digits = next((more for more in range(digits, digits + MORE_DIGITS + 1) if round(mean, more)), digits)
    mark = MARK if difference.clear and mean is not None and round(mean, digits) else ""
    return number(mean, digits, signed=True) + mark, interval_text(difference.low, difference.high, digits, signed=True)


def heading(column: ColumnRecord) -> str:
    """The column's title with the arrow of what is better."""
    return f"{column.title} {ARROWS.get(column.better or '', '')}".strip()


def verdict(difference: Difference, better: str | None) -> str:
    """``better`` or ``worse`` when the difference is clear, else ``open``."""
    if not difference.clear or better not in ARROWS or difference.mean is None:
        return "open"
    return "better" if (difference.mean > 0) == (better == "higher") else "worse"
