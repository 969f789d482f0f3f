"""Trackers get the losses of the run's own log."""

from __future__ import annotations

import importlib.util
import json

import pytest

from tests.support.micro_runs import stage


def test_tensorboard_gets_the_losses_of_the_log(persist, walks, codec, tmp_path):
    loading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    arguments = stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.tracker=tensorboard")
    assert persist(*arguments).code == 0
    events = loading.EventAccumulator(str(tmp_path / "run" / "persist")).Reload()
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    tracked = [(event.step, event.value) for event in events.Scalars("loss")]
    assert tracked == [(row["step"], pytest.approx(row["loss"], rel=1e-5)) for row in logged]


def test_a_tracker_that_is_not_installed_ends_in_one_line(persist, walks, codec, tmp_path):
    if importlib.util.find_spec("tensorboard") is not None:
        pytest.skip("tensorboard is installed")
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.tracker=tensorboard"))
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
    assert "needs the package tensorboard: pip install 'persist-cli[tensorboard]'" in ended.err
    assert not (tmp_path / "run").exists()
