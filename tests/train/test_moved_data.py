"""A run knows its data by the names and sizes of their files, wherever these lie when it goes on."""

from __future__ import annotations

import shutil

from tests.support.micro_runs import stage


def test_a_run_goes_on_with_its_data_at_another_place_and_with_no_others(persist, walks, codec, tmp_path):
    data, moved = tmp_path / "data", tmp_path / "moved"
    shutil.copytree(walks, data)
    run = stage("stage1", data, tmp_path / "run", f"base={codec}", "training.steps=1")
    assert persist(*run).code == 0
    data.rename(moved)
    again = [str(moved) if word == str(data) else word for word in run]
    assert persist(*again, "training.steps=2", "--resume").code == 0
    assert not (tmp_path / "run/data.json").read_text().count(str(tmp_path))
    sorted(moved.glob("*.parquet"))[0].unlink()
    ended = persist(*[str(walks) if word == str(data) else word for word in run], "training.steps=3", "--resume")
    assert ended.code == 0  # whole again
    moved.rename(data)
    assert "data.path changed" in persist(*run, "training.steps=4", "--resume").err
