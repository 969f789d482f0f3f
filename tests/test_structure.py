"""Functions and modules stay small, and every module stands in its layer."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("persist_cli", "backbones", "memory", "recipes")
PLUGINS = ("backbones/persist_backbones", "memory/persist_memory")
PLUGIN_API = ("persist_cli.api.", "persist_cli.io.", "persist_cli.errors.")


def modules(*folders: str) -> Iterator[tuple[str, str]]:
    """Path and text of every module in these folders."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")


def imported_names(text: str) -> set[str]:
    """Dotted names of all modules that a module imports, and of what it imports from them."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_no_function_is_over_50_lines():
    long_functions = [
        f"{path}:{node.lineno} {node.name}"
        for path, text in modules(*PRODUCT, "tests")
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (node.end_lineno or 0) - node.lineno + 1 > 50
    ]
    assert long_functions == []


def test_no_module_is_over_450_lines():
    assert [path for path, text in modules(*PRODUCT, "tests") if text.count("\n") > 450] == []


def test_plugins_import_of_the_tool_only_what_is_made_for_them():
    forbidden = [
        f"{path}: {name}"
        for path, text in modules(*PLUGINS)
        for name in imported_names(text)
        if name.split(".")[0] == "persist_cli" and not f"{name}.".startswith(PLUGIN_API)
    ]
    assert forbidden == []


def test_every_module_of_the_tool_stands_in_a_layer():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = {name.strip() for layer in contracts[0]["layers"] for name in layer.split("|")}
    paths = [
        path for path in (ROOT / "persist_cli").iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()
    ]
    assert {f"persist_cli.{path.stem}" for path in paths} - {"persist_cli.__init__"} <= layers
