"""``persist finetune --dry-run``: what would be trained, part by part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from persist_cli.api.stages import ParameterGroup, Stage
from persist_cli.doctor.machine import gib
from persist_cli.doctor.meta_model import MetaModel, build_meta_model
from persist_cli.viewing.console import print_json, print_table


def run_dry_run(recipe: str, overrides: Sequence[str], json: bool) -> None:
    """Print every part's parameters, how many are new and how many each stage trains; nothing is read or written."""
    planned = build_meta_model(recipe, overrides)
    record = dry_run(planned)
    if json:
        print_json({"recipe": recipe} | record)
        return
    stages = list(record["total"]["trained"])
    title = f"{recipe}: stage {planned.recipe.stage} of {planned.backbone.name}"
    columns = ["part", "parameters", "GiB", "new", *(f"{_spoken(stage)} trains" for stage in stages)]
    print_table(title, columns, [_row(part) for part in [*record["parts"], record["total"]]])


def dry_run(planned: MetaModel) -> dict[str, Any]:
    """The same as plain values, with the name and shape of every parameter; sizes are those of the weights alone."""
    parts = planned.backbone.parameter_groups()
    trained = {stage: _trained(planned, stage) for stage in _stages(planned)}
    records = [_record(part, trained) for part in parts]
    total = {
        "name": "total",
        **{key: sum(each[key] for each in records) for key in ("parameters", "bytes", "new")},
        "trained": {stage: sum(each["trained"][stage] for each in records) for stage in trained},
    }
    return {
        "stage": planned.recipe.stage,
        "backbone": planned.backbone.name,
        "base": str(planned.base.folder) if planned.base else None,
        "parts": records,
        "total": total,
    }


def _stages(planned: MetaModel) -> tuple[Stage, ...]:
    return ("codec", "1") if planned.recipe.memory is None else ("codec", "1", "2")


def _trained(planned: MetaModel, stage: Stage) -> set[str]:
    return set(planned.backbone.trained_parameters(stage))


def _record(part: ParameterGroup, trained: dict[Stage, set[str]]) -> dict[str, Any]:
    sizes = {name: parameter.numel() for name, parameter in part.parameters.items()}
    parameters = sum(sizes.values())
    return {
        "name": part.name,
        "parameters": parameters,
        "bytes": sum(each.numel() * each.element_size() for each in part.parameters.values()),
        "new": parameters if part.new else 0,
        "trained": {stage: sum(sizes[name] for name in sizes if name in names) for stage, names in trained.items()},
        "shapes": {name: list(parameter.shape) for name, parameter in part.parameters.items()},
    }


def _row(record: dict[str, Any]) -> list[str]:
    counts = [record["new"], *record["trained"].values()]
    size = gib(record["bytes"])
    return [record["name"], f"{record['parameters']:,}", size, *(f"{count:,}" if count else "-" for count in counts)]


def _spoken(stage: Stage) -> str:
    return "codec" if stage == "codec" else f"stage {stage}"
