"""The result file of ``persist eval``, read from JSON and checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, model_validator

from persist_cli.errors import DataError
from persist_cli.evaluate.statistics import LEAST_UNITS
from persist_cli.io.files import read_json
from persist_cli.io.settings import plain_problems

FORMAT = "persist-evaluation"

VERSION = 1

FILE = "results.json"  # in the folder of a report

FILES = (FILE, "metrics.json")  # the latter in the folder of ``persist eval --out``


def _finite_or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


FiniteOrNone = Annotated[float | None, BeforeValidator(_finite_or_none)]


class ResultModel(BaseModel):
    """A part of the results; unknown keys are ignored, so that results of a later persist can still be read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class PoseLimits(ResultModel):
    """A pose is new if no frame in memory is nearer than both."""

    metres: float
    degrees: float


class ProtocolRecord(ResultModel):
    """The protocol that chose the clips and filled the memory.

    Of the predicted frames those count whose pose is new; results of earlier versions counted all.
    """

    name: str
    title: str = ""
    definition: str = ""
    frames: int
    new_poses: PoseLimits | None = None
    counted_frames: int | None = None
    predicted_frames: int | None = None


class DataSet(ResultModel):
    """A data set with the hash of each trajectory that was used, and the split that each is of, where it says so.

    ``address`` is what the folder mirrors, ``None`` where it is no mirror.
    """

    path: str
    address: str | None = None
    trajectories: dict[str, str]
    splits: dict[str, str] = {}


class ClipRecord(ResultModel):
    """One clip; ``data`` is the number of its data set, ``seen_before`` holds a share for each frame.

    ``counted`` says which frames count and ``first_visits`` which earlier frame each returns to, -1 for none. Both
    depend on how many frames the model predicts at once; results of earlier versions lack them.
    """

    data: int
    trajectory: str
    scene: str | int | None = None
    start: int
    frames: int
    seen_before: list[FiniteOrNone] = []
    counted: list[bool] = []
    first_visits: list[int] = []
    path_metres: FiniteOrNone = None
    farthest_metres: FiniteOrNone = None
    turned_degrees: FiniteOrNone = None


class MetricRecord(ResultModel):
    """A metric's definition with the hash of each weight it used, and where that came from."""

    title: str
    better: str | None = None
    definition: str
    weights: dict[str, str] = {}
    sources: dict[str, str] = {}


class Measured(ResultModel):
    """Everything that two runs must share to be comparable."""

    protocol: ProtocolRecord
    data: list[DataSet]
    image_size: tuple[int, int]
    clips: list[ClipRecord]
    metrics: dict[str, MetricRecord]


class ColumnRecord(ResultModel):
    """A column of the table: a metric over all frames, the last one, the returns, or the views that are new."""

    metric: str
    title: str
    better: str | None = None
    definition: str = ""
    frames: str = "all"


class Difference(ResultModel):
    """Paired difference to another row with its 95 % interval."""

    mean: FiniteOrNone
    low: FiniteOrNone = None
    high: FiniteOrNone = None

    @property
    def clear(self) -> bool:
        """Whether the interval is known and leaves zero out."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


class Cell(ResultModel):
    """A figure with its spread, or in ``na`` the reason why there is none.

    ``units`` counts the scenes, or clips, that its interval was drawn from, and ``clip_weights`` says how much each
    clip counts where this differs. Intervals of fewer than ``LEAST_UNITS`` clips, which earlier versions wrote, are
    left out on reading.
    """

    na: str | None = None
    mean: FiniteOrNone = None
    std: FiniteOrNone = None
    low: FiniteOrNone = None
    high: FiniteOrNone = None
    count: int | None = None
    units: int | None = None
    by_training_seed: list[FiniteOrNone] = []
    per_clip: list[FiniteOrNone] | None = None
    clip_weights: list[float] | None = None
    difference: Difference | None = None
    differences: dict[str, Difference | None] = {}

    @model_validator(mode="before")
    @classmethod
    def _drop_intervals_of_few_clips(cls, values: Any) -> Any:
        if not isinstance(values, dict) or not isinstance(values.get("count"), int) or values["count"] >= LEAST_UNITS:
            return values
        gaps = values.get("differences")
        kept = {"difference": _without_interval(values.get("difference"))}
        if isinstance(gaps, dict):
            kept["differences"] = {name: _without_interval(gap) for name, gap in gaps.items()}
        return _without_interval(values) | kept


def _without_interval(values: Any) -> Any:
    return values | {"low": None, "high": None} if isinstance(values, dict) else values


class Bin(ResultModel):
    """Frames whose view was seen before to a share from ``low`` to ``high``."""

    low: float
    high: float
    mean: FiniteOrNone
    count: int

    @property
    def middle(self) -> float:
        """The share in the middle between ``low`` and ``high``."""
        return (self.low + self.high) / 2


class Curve(ResultModel):
    """A metric frame by frame, the last value at the clip's last frame, and by the seen-before share of the view."""

    per_frame: list[FiniteOrNone] = []
    by_seen_before: list[Bin] = []


class ReadsRecord(ResultModel):
    """What a row's memory stores, and what was read from it for a generated clip on average.

    ``resolution`` is the edge in metres of the smallest thing that it can tell apart at ``distance`` metres.
    """

    resolution: float | None = None
    distance: float
    reads_depth: bool
    tokens: float | None = None
    bytes: float | None = None


class RowRecord(ResultModel):
    """A row of the table, or in ``na`` the reason why it cannot be made of these clips.

    ``training_seeds`` has the seeds of the stages of each model, which stand on so many different ``bases``; ``truth``
    says what of the truth it is given, and ``windows`` has means along the rollout by metric.
    """

    kind: Literal["model", "control", "memory control"]
    definition: str = ""
    na: str | None = None
    checkpoint: str | None = None
    memory: str | None = None
    reads: ReadsRecord | None = None
    truth: str = ""
    training_seeds: list[list[int]] = []
    bases: int | None = None
    columns: dict[str, Cell]
    curves: dict[str, Curve] = {}
    windows: dict[str, list[FiniteOrNone]] = {}


class TableRecord(ResultModel):
    """A table over some of the clips, which show so many scenes."""

    name: str
    clips: list[int]
    scenes: int | None = None
    rows: dict[str, RowRecord]


class KnownScenes(ResultModel):
    """The number of scenes that a checkpoint is known to have been trained on, and whether these are all.

    ``evaluated`` names those of them that the evaluated clips show; results of earlier versions do not say.
    """

    known: int
    complete: bool
    evaluated: list[str] | None = None


class CheckpointRecord(ResultModel):
    """A checkpoint with the hashes of its parts."""

    name: str
    path: str = ""
    fingerprint: str = ""
    recipe_sha256: str | None = None
    training_scenes: KnownScenes | None = None
    adapters: dict[str, str] = {}
    adapter_settings: dict[str, str] = {}
    chosen_on: str | None = None


class SamplingSettings(ResultModel):
    """How clips were sampled."""

    steps: int | None = None
    sampler: str | None = None
    memory_guidance: float | None = None
    context_noise: float = 0.0
    autoguidance: float = 1.0


class SamplingRecord(SamplingSettings):
    """The sampling of the rows of models, and who chose it.

    ``sampling_of`` has that of the memories whose rows are sampled in another way. Results of earlier versions, where
    it is ``None``, say it in the rows' definitions alone.
    """

    chosen: str = ""
    sampling_of: dict[str, SamplingSettings] | None = None
    dtype: str | None = None
    tiling: bool = False
    seeds: list[int] = []
    batch: int | None = None


class StatisticsRecord(ResultModel):
    """What bootstrap samples draw; results of earlier versions, which do not say it, drew clips.

    ``set_resamples`` is the number of those of distances between sets, as FVD.
    """

    resampled: Literal["scenes", "clips"] = "clips"
    resamples: int | None = None
    set_resamples: int | None = None


class EvalResults(ResultModel):
    """All results of one ``persist eval``.

    ``windows`` has the first and the last frame of each of the rows' windows, by metric; results of earlier versions do
    not say them.
    """

    measured: Measured
    sampling: SamplingRecord
    statistics: StatisticsRecord = StatisticsRecord()
    training_scenes_allowed: bool = False
    environment: dict[str, Any] = {}
    command: list[str] = []
    checkpoints: list[CheckpointRecord] = []
    columns: dict[str, ColumnRecord]
    tables: list[TableRecord]
    first_row: str | None = None
    windows: dict[str, list[tuple[int, int]]] = {}


def read_results(path: Path) -> EvalResults:
    """Read results from a JSON file, or from the folder of an evaluation or a report.

    Raises:
        DataError: one line when it is missing, not JSON, not results, or of another version.
    """
    file = path
    if path.is_dir():
        file = next((path / name for name in FILES if (path / name).is_file()), path / FILE)
    value = read_json(file, DataError, "no such file; `persist eval` writes it")
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise DataError(f"{file}: not the results of `persist eval` (no format {FORMAT!r} in it)")
    if value.get("version") != VERSION:
        raise DataError(f"{file}: results of version {value.get('version')!r}; this persist reads version {VERSION}")
    return check_results(value, str(file))


def check_results(value: Mapping[str, Any], where: str) -> EvalResults:
    """Check results that are JSON values.

    Raises:
        DataError: one line that names ``where`` and the first key that does not fit.
    """
    try:
        results = EvalResults.model_validate(value)
    except ValidationError as error:
        raise DataError(f"{where}: results are damaged: {plain_problems(EvalResults, value, error)[0]}") from error
    for table in results.tables:
        if not all(0 <= number < len(results.measured.clips) for number in table.clips):
            raise DataError(f"{where}: results are damaged: table {table.name!r} names clips that are not there")
        for name, row in table.rows.items():
            for column, cell in row.columns.items():
                for what, values in (("figures", cell.per_clip), ("weights", cell.clip_weights)):
                    if values is not None and len(values) != len(table.clips):
                        raise DataError(
                            f"{where}: results are damaged: {table.name}, {name}, {column} has {len(values)} {what} "
                            f"for {len(table.clips)} clips"
                        )
    return results
