"""By what a run knows again what it reads besides its base: weights by their hashes, data by names and sizes."""

from __future__ import annotations

import shutil
from types import SimpleNamespace
from typing import Any

import pytest

from persist_cli.checkpoints.load import named_adapter
from persist_cli.errors import CheckpointError
from persist_cli.io.files import write_json
from persist_cli.train.sources import DATA, data_files, find_model, has_same_data, weights_hash
from tests.support.export_runs import write_adapter, write_base


def test_an_adapter_is_known_by_its_own_weights_and_not_by_its_base_alone(tmp_path):
    backbone = write_base(tmp_path / "base")
    one, other = (write_adapter(backbone, tmp_path / "base", tmp_path / name, "voxel") for name in ("one", "other"))
    hashes = [weights_hash(*named_adapter(str(folder))) for folder in (one, other)]
    assert [find_model(str(one), "2", wanted).folder for wanted in (None, hashes[0])] == [one, one]
    with pytest.raises(CheckpointError, match=r"the weights that the run began to distil .* are not there any more"):
        find_model(str(one), "2", hashes[1])


def test_data_of_the_same_names_and_other_sizes_are_others(walks, tmp_path):
    folder = shutil.copytree(walks, tmp_path / "data")
    recipe: Any = SimpleNamespace(data=SimpleNamespace(path=[str(folder)]))
    write_json(tmp_path / DATA, data_files(recipe))
    assert has_same_data(recipe, tmp_path)
    first, second = sorted(folder.glob("*.parquet"))
    assert first.stat().st_size != second.stat().st_size
    shutil.copy(second, first)
    assert not has_same_data(recipe, tmp_path)
