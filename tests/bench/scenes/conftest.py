"""Data sets of houses of cells, and a micro model of scenes with weights of no training."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from persist_cli.checkpoints.scene_models import save_scene_model
from tests.support.cell_houses import FORM, write_cell_houses
from tests.support.micro_runs import run_persist, stage
from tests.support.micro_scenes import micro_model


@pytest.fixture(scope="session")
def test_houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two houses to measure in."""
    return write_cell_houses(tmp_path_factory.mktemp("cells") / "test", [5, 7])


@pytest.fixture(scope="session")
def train_houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five other houses."""
    return write_cell_houses(tmp_path_factory.mktemp("cells") / "train", [2, 4, 6, 8, 10])


@pytest.fixture(scope="session")
def scene_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of the houses' classes that was not trained."""
    folder = tmp_path_factory.mktemp("models") / "scene"
    folder.mkdir()
    model = micro_model(palette=list(FORM.palette), shape=[16, 16, 12])
    model.name = "scene"
    save_scene_model(model, "scene", folder, None)
    return folder


@pytest.fixture(scope="session")
def renderer(train_houses: Path, stage1: Path) -> Path:
    """A stage-2 run of four steps of an adapter that draws scenes."""
    run = stage1.parent / "scene"
    memory = {"name": "scene", "settings": {"palette": list(FORM.palette)}, "encoder": "classes"}
    changes = [f"memory={json.dumps(memory)}", "adapter.form=rendered", "data.true_cells=1", "data.mirror=false"]
    run_persist(*stage("stage2-voxel", train_houses, run, f"base={stage1}", *changes))
    return run
