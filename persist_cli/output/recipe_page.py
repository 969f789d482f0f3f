"""``persist recipes NAME``: a recipe with every setting, its default and its meaning, as YAML to start from."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import yaml

from persist_cli.api.stages import Stage
from persist_cli.io.setting_docs import Setting, settings_of
from persist_cli.io.settings import parse_settings
from persist_cli.output.console import busy, print_json, say
from persist_cli.plugins import load_plugin, make_settings, network_type
from persist_cli.recipe import (
    ALONE,
    DATA_OF,
    OF_A_BACKBONE,
    Recipe,
    make_recipe,
    network_of,
    read_recipe,
    recipe_comment,
    to_plain,
)

WIDTH: Final = 80  # columns of a comment

STAGES_OF: Final[dict[str, tuple[Stage, ...]]] = {
    "memory": ("2",),
    "adapter": ("2",),
    "lora": ("1",),
    "distill": ("1", "2"),
    "adversarial": ("1", "2"),
    **ALONE,
}

NOT_ALONE: Final = {"backbone", "adapter_from"}  # settings of the stages of a backbone

OF_THE_BASE: Final = "what is not set here is as in the checkpoint that base names, not as shown"

UNBROKEN: Final = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Entry:
    """A setting as a recipe has it.

    Args:
        setting: its name, default and meaning.
        value: its value in the recipe, else its default.
        given: whether it stands in the YAML; else it stands there as a comment.
        inside: the settings that it holds, ``None`` where it is a single value.
    """

    setting: Setting
    value: Any
    given: bool = True
    inside: tuple[Entry, ...] | None = None


def show_recipe(name: str, json: bool) -> None:
    """Print a recipe with every setting.

    Args:
        name: name of a recipe of the package, or a YAML file.
        json: whether JSON is printed instead of YAML.

    Raises:
        PersistError: when the recipe is unknown or wrong, or a plugin that it names cannot be used.
    """
    recipe = make_recipe(read_recipe(name), name)
    with busy("reading the settings of the plugins"):
        entries = recipe_entries(recipe)
    if json:
        print_json({"recipe": name, "resolved": to_plain(recipe), "settings": [*_records(entries, "")]})
    else:
        say(recipe_yaml(name, recipe, entries))


def recipe_entries(recipe: Recipe) -> list[Entry]:
    """The settings of a recipe in their order; those that its stage does not have are left out.

    Raises:
        PersistError: when a plugin cannot be used, or does not have the settings that the recipe gives it.
    """
    values, of_plugins = to_plain(recipe), _plugin_settings(recipe)
    kind, stage = network_of(recipe), recipe.stage
    settings = [setting for setting in settings_of(Recipe) if stage in STAGES_OF.get(setting.name, (stage,))]
    if kind is not None:
        settings = [_of_a_network(setting, kind) for setting in settings if setting.name not in NOT_ALONE]
    return [_entry(setting, values[setting.name], setting.name, of_plugins) for setting in settings]


def recipe_yaml(name: str, recipe: Recipe, entries: Iterable[Entry]) -> str:
    """A recipe as YAML with a comment at every setting; settings that it does not give are comments too."""
    usage = (
        f"The recipe {name} with every setting. Where a # stands right before a setting, it has the value shown; "
        "take the # away to give it another one."
    )
    head = [*recipe_comment(name), "", *_wrapped(usage, 0)]
    if recipe.base is None:
        return "\n".join([*head, *_lines(entries, 0)])
    marked = [_with_base_remark(entry) if entry.setting.name == "backbone" else entry for entry in entries]
    return "\n".join([*head, *_lines(marked, 0)])


def _plugin_settings(recipe: Recipe) -> dict[str, list[Setting]]:
    """The settings that plugins have, by the dotted key under which a recipe gives them."""
    if recipe.policy is not None:
        network = network_type(recipe.policy.name).settings_type
        parse_settings(network, recipe.policy.settings, f"the network of policy {recipe.policy.name!r}")
        return {"policy.settings": settings_of(network)}
    if recipe.scene is not None:
        model = load_plugin("scene model", recipe.scene.name).settings_type
        make_settings("scene model", recipe.scene.name, recipe.scene.settings)
        return {"scene.settings": settings_of(model)}
    config = recipe.backbone
    backbone = load_plugin("backbone", config.name)
    make_settings("backbone", config.name, config.settings)
    settings = {"backbone.settings": settings_of(backbone.settings_type)}
    if recipe.memory is not None:
        memory, encoder = load_plugin("memory", recipe.memory.name), load_plugin("encoder", recipe.memory.encoder)
        make_settings("memory", recipe.memory.name, recipe.memory.settings)
        make_settings("encoder", recipe.memory.encoder, recipe.memory.encoder_settings)
        settings["memory.settings"] = settings_of(memory.settings_type)
        settings["memory.encoder_settings"] = settings_of(encoder.settings_type)
        settings["adapter"] = backbone.adapter_settings(recipe.adapter)
    return settings


def _of_a_network(setting: Setting, kind: str) -> Setting:
    """The setting without those inside that mean nothing to a policy or a model of scenes."""
    absent = {"data": {inner.name for inner in setting.inside} - {*DATA_OF[kind]}, "training": {*OF_A_BACKBONE}}
    hidden = absent.get(setting.name, set())
    return replace(setting, inside=tuple(inner for inner in setting.inside if inner.name not in hidden))


def _entry(setting: Setting, value: Any, key: str, of_plugins: Mapping[str, list[Setting]]) -> Entry:
    if key in of_plugins:
        own = {inner.name: inner for inner in of_plugins[key]}
        others = [Setting(name, "") for name in value if name not in own]  # of a plugin that does not tell its settings
        inside = [
            Entry(inner, value.get(inner.name, inner.default), inner.name in value)
            for inner in [*own.values(), *others]
        ]
        return Entry(setting, value, True, tuple(inside))
    if not setting.inside:
        return Entry(setting, value)
    held = value or {inner.name: inner.default for inner in setting.inside}
    inside = [_entry(inner, held[inner.name], f"{key}.{inner.name}", of_plugins) for inner in setting.inside]
    return Entry(setting, value, value is not None, tuple(inside))


def _with_base_remark(backbone: Entry) -> Entry:
    inside = [
        replace(entry, setting=replace(entry.setting, meaning=f"{entry.setting.meaning}; {OF_THE_BASE}"))
        if entry.setting.name == "settings"
        else entry
        for entry in backbone.inside or ()
    ]
    return replace(backbone, inside=tuple(inside))


def _lines(entries: Iterable[Entry], depth: int) -> Iterator[str]:
    """Lines of YAML; a mapping that is not given is a comment as a whole."""
    for entry in entries:
        if depth == 0:
            yield ""
        yield from _wrapped(_comment(entry), depth)
        body = [*_body(entry)]
        mark = "" if entry.given else "#"
        yield from (f"{'  ' * depth}{mark}{line}" for line in body)


def _body(entry: Entry) -> Iterator[str]:
    """The lines of a setting itself, not indented."""
    name = entry.setting.name
    if entry.inside:
        yield f"{name}:"
        yield from _lines(entry.inside, 1)
    elif isinstance(entry.value, dict) and entry.value:
        yield f"{name}:"
        block = yaml.safe_dump(entry.value, sort_keys=False, default_flow_style=None, width=math.inf)
        yield from textwrap.indent(block, "  ").splitlines()
    else:
        yield f"{name}: {_in_one_line(entry.value)}"


def _comment(entry: Entry) -> str:
    """What a setting means and allows, and its default where the recipe has another value."""
    setting = entry.setting
    parts = [setting.meaning, setting.allowed]
    differs = entry.given and not entry.inside and not setting.needed and entry.value != setting.default
    if differs and setting.default != "":
        parts.append(f"default {_in_one_line(setting.default)}".replace(" ", UNBROKEN))
    return "; ".join(part for part in parts if part)


def _wrapped(text: str, depth: int) -> list[str]:
    indent = f"{'  ' * depth}# "
    lines = textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False)
    return [line.replace(UNBROKEN, " ") for line in lines]


def _in_one_line(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, width=math.inf, allow_unicode=True)
    return text.removesuffix("...\n").strip()


def _records(entries: Iterable[Entry], prefix: str) -> Iterator[dict[str, Any]]:
    """Every single setting as JSON values, by its dotted key."""
    for entry in entries:
        key = f"{prefix}{entry.setting.name}"
        if entry.inside is not None:
            yield from _records(entry.inside, f"{key}.")
            continue
        setting = entry.setting
        yield {
            "key": key, "value": entry.value, "default": setting.default, "needed": setting.needed,
            "given": entry.given, "meaning": setting.meaning, "allowed": setting.allowed,
        }  # fmt: skip
