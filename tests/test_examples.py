"""The notebook runs, and the examples of plugins are installed like any package and work in every command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

from persist_cli.plugins import find_plugin
from tests.support.micro_runs import stage, write_loops

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOK = EXAMPLES / "walk.ipynb"
PACKAGES = EXAMPLES / "persist-last-frame", EXAMPLES / "persist-fan"


def test_the_notebook_holds_no_output_and_its_cells_are_valid():
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["metadata"]["kernelspec"]["language"]) == (4, "python")
    for cell in notebook["cells"]:
        wanted = {"cell_type", "id", "metadata", "source"}
        wanted |= {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        assert set(cell) == wanted
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])


def test_the_cells_of_the_notebook_run_and_the_memory_helps(tmp_path, monkeypatch):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)
    names: dict[str, object] = {}
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    matplotlib.pyplot.close("all")
    assert names["psnr"](names["with_memory"]).mean() > names["psnr"](names["without"]).mean() + 2


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder into which pip has installed the packages."""
    pytest.importorskip("hatchling", reason="pip builds the examples with hatchling, which is in the extra dev")
    folder = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", folder, *PACKAGES], check=True, capture_output=True, text=True)
    return folder


@pytest.fixture
def installed(site, monkeypatch) -> Path:
    """The packages are found in the environment, by their entry points."""
    monkeypatch.syspath_prepend(str(site))
    return site


@pytest.mark.parametrize(
    ("kind", "name", "package", "target"),
    [
        ("memory", "last", "persist-last-frame", "persist_last_frame:LastFrame"),
        ("policy", "fan", "persist-fan", "persist_fan:Fan"),
        ("cost", "colors", "persist-fan", "persist_fan:ColorDifference"),
    ],
)
def test_a_package_is_found_by_its_entry_points(installed, persist, kind, name, package, target):
    plugin = find_plugin(kind, name)
    assert (plugin.package, plugin.target) == (package, target)
    rows = json.loads(persist("plugins", "--json").out)
    assert package in json.dumps(rows)


def test_a_memory_of_ones_own_works_in_every_command(installed, persist, walks, stage1, voxel, tmp_path):
    def run(*arguments):
        ended = persist(*arguments)
        assert ended.code == 0, ended.err
        return ended.out

    run("inspect", walks, "--pairs", 8)
    run(*stage("stage2-voxel", walks, tmp_path / "last", f"base={stage1}", "memory.name=last"))
    run("memorize", f"{walks}#0:0-8", "--checkpoint", tmp_path / "last", "--out", tmp_path / "last.safetensors")
    way = ("--start", f"{walks}#0:8", "--actions", "left*2", "--steps", 2)
    run("rollout", tmp_path / "last", *way, "--memory", tmp_path / "last.safetensors", "--out", tmp_path / "walk")
    run("export", stage1, voxel, tmp_path / "last", "--default", "last", "--out", tmp_path / "model")
    run("rollout", tmp_path / "model", *way, "--out", tmp_path / "again")
    rows = ("--memories", "voxel,last", "--controls", "emptied", "--metrics", "psnr")
    few = ("--seeds", 1, "--steps", 2, "--clips", 2, "--out", tmp_path / "eval")
    run("eval", tmp_path / "model", "--data", write_loops(tmp_path / "data"), *rows, *few)
    assert '"last"' in (tmp_path / "eval/metrics.json").read_text()


def test_a_policy_and_a_cost_of_ones_own_make_plans(installed, persist, walks, voxel, tmp_path):
    way = ("--start", f"{walks}#0:2", "--goal", f"{walks}#0:5", "--horizon", 3, "--steps", 1, "--candidates", 4)
    ours = ("--method", "rank", "--policy", "fan", "--cost", "colors", "--set", "policy.turns=1", "--json")
    ended = persist("plan", voxel, *way, *ours, "--set", "cost.cells=4", "--out", tmp_path / "plan")
    assert ended.code == 0, ended.err
    record = json.loads(ended.out)
    found = {candidate["actions"] for candidate in record["candidates"]}
    assert found >= {"forward*3", "left forward*2", "right forward*2"}
    assert record["cost"] == {"name": "colors", "settings": {"cells": 4}, "over": "last"}
    refused = persist("plan", voxel, *way, *ours, "--set", "cost.cell=4", "--out", tmp_path / "refused")
    assert "unknown key 'cell', did you mean 'cells'?" in refused.err


def test_the_tests_of_the_packages_pass(installed, tmp_path):
    options = ["-q", "-p", "no:cacheprovider", "--import-mode=importlib"]
    pytest_run = [sys.executable, "-m", "pytest", *options, *(package / "tests" for package in PACKAGES)]
    ended = subprocess.run(pytest_run, capture_output=True, text=True, cwd=tmp_path, env=environment(installed))
    assert ended.returncode == 0, ended.stdout


def environment(site: Path) -> dict[str, str]:
    """The environment of a process that finds what is installed in a folder, and the packaged sample."""
    import os

    paths = [str(site), *(path for path in sys.path if path)]
    kept = {name: value for name, value in os.environ.items() if name != "PERSIST_REFERENCE"}
    return kept | {"PYTHONPATH": os.pathsep.join(paths)}
