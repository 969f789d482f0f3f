"""``persist finetune --dry-run``: what would be trained, part by part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from persist_cli.api.meta_device import without_weights
from persist_cli.api.stages import ParameterGroup, Stage
from persist_cli.checkpoints.scene_models import check_stage
from persist_cli.doctor.machine import gib
from persist_cli.doctor.meta_model import MetaModel, build_meta_model
from persist_cli.output.console import print_json, print_table
from persist_cli.plugins import make_scene_model
from persist_cli.policies.trained import make_network
from persist_cli.recipe import ALONE, Recipe, apply_overrides, make_recipe, read_recipe


def run_dry_run(recipe: str, overrides: Sequence[str], json: bool) -> None:
    """Print every part's parameters, how many are new and how many each stage trains; nothing is read or written."""
    network = network_recipe(recipe, overrides)
    record = dry_run(build_meta_model(recipe, overrides)) if network is None else network_dry_run(network)
    if json:
        print_json({"recipe": recipe} | record)
        return
    stages = [f"stage {stage}" if stage.isdigit() else stage for stage in record["total"]["trained"]]
    title = f"{recipe}: stage {record['stage']} of {record.get('backbone') or record.get('policy') or record['scene']}"
    columns = ["part", "parameters", "GiB", "new", *(f"{stage} trains" for stage in stages)]
    print_table(title, columns, [_row(part) for part in [*record["parts"], record["total"]]])


def dry_run(meta_model: MetaModel) -> dict[str, Any]:
    """The parts of the model as JSON values, with the name and shape of every parameter; sizes are those of weights."""
    stages: tuple[Stage, ...] = ("codec", "1") if meta_model.recipe.memory is None else ("codec", "1", "2")
    groups = meta_model.backbone.parameter_groups()
    return {
        "stage": meta_model.recipe.stage,
        "backbone": meta_model.backbone.name,
        "base": str(meta_model.base.folder) if meta_model.base else None,
        **_parts(groups, {stage: identities(meta_model.backbone.trained_parameters(stage)) for stage in stages}),
    }


def network_recipe(name: str, overrides: Sequence[str]) -> Recipe | None:
    """The recipe with KEY=VALUE changes where it trains a policy or a model of scenes, ``None`` for a backbone."""
    values = apply_overrides(read_recipe(name), overrides)
    if not any(values.get("stage") in stages for stages in ALONE.values()):
        return None
    return make_recipe(values, name)


def network_dry_run(recipe: Recipe) -> dict[str, Any]:
    """The parts of a policy's network or of a model of scenes as JSON values, as those of ``dry_run``."""
    with without_weights():
        if recipe.policy is not None:
            network = make_network(recipe.policy.name, recipe.policy.settings)
            trained: dict[Stage, set[int]] = {"policy": identities(network.trained_parameters())}
            named = {"stage": recipe.stage, "policy": recipe.policy.name, "base": recipe.base}
            return named | _parts(network.parameter_groups(), trained)
        assert recipe.scene is not None
        model = make_scene_model(recipe.scene.name, recipe.scene.settings)
    check_stage(model, recipe.stage)
    trained = {stage: identities(model.trained_parameters(stage)) for stage in model.stages}
    named = {"stage": recipe.stage, "scene": recipe.scene.name, "base": recipe.base}
    return named | _parts(model.parameter_groups(), trained)


def identities(parameters: Mapping[str, nn.Parameter]) -> set[int]:
    """The identities of parameters, which may have other names in a part of the model than in the whole."""
    return {id(parameter) for parameter in parameters.values()}


def _parts(groups: Sequence[ParameterGroup], trained: dict[Stage, set[int]]) -> dict[str, Any]:
    parts = [_part(group, trained) for group in groups]
    total = {
        "name": "total",
        **{key: sum(part[key] for part in parts) for key in ("parameters", "bytes", "new")},
        "trained": {stage: sum(part["trained"][stage] for part in parts) for stage in trained},
    }
    return {"parts": parts, "total": total}


def _part(group: ParameterGroup, trained: dict[Stage, set[int]]) -> dict[str, Any]:
    sizes = {id(parameter): parameter.numel() for parameter in group.parameters.values()}
    parameters = sum(sizes.values())
    return {
        "name": group.name,
        "parameters": parameters,
        "bytes": sum(parameter.numel() * parameter.element_size() for parameter in group.parameters.values()),
        "new": parameters if group.new else 0,
        "trained": {stage: sum(sizes[one] for one in sizes if one in among) for stage, among in trained.items()},
        "shapes": {name: list(parameter.shape) for name, parameter in group.parameters.items()},
    }


def _row(part: dict[str, Any]) -> list[str]:
    counts = [part["new"], *part["trained"].values()]
    size = gib(part["bytes"])
    return [part["name"], f"{part['parameters']:,}", size, *(f"{count:,}" if count else "-" for count in counts)]
