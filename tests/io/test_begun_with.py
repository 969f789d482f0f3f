"""What a folder of results was begun with, compared with what is asked now."""

from __future__ import annotations

import pytest

from persist_cli.errors import PersistError
from persist_cli.io.begun_with import check_same


def plan(path: str, fingerprint: str) -> dict[str, object]:
    """Part of an evaluation's plan."""
    return {"models": [{"path": path, "fingerprint": fingerprint}], "batch": 1}


def test_a_checkpoint_that_was_moved_is_the_same_one():
    check_same(plan("/home/ada/runs/voxel", "1f"), plan("/data/voxel", "1f"), "runs/eval: holds another evaluation")


def test_another_checkpoint_in_the_same_place_is_refused():
    with pytest.raises(PersistError, match=r"another evaluation .*fingerprint: 1f, now 2e"):
        check_same(plan("/data/voxel", "1f"), plan("/data/voxel", "2e"), "runs/eval: holds another evaluation")


def test_what_an_earlier_version_did_not_write_is_not_compared():
    earlier, settings = plan("/data/voxel", "1f"), {"adapter_settings": {"voxel": "3a"}}
    now = earlier | {"models": [{"path": "/data/voxel", "fingerprint": "1f"} | settings], "autoguidance": 1.0}
    check_same(earlier, now, "runs/eval: holds another evaluation")
    check_same({"steps": 4}, {"steps": 4, "autoguidance": None}, "runs/eval: holds another evaluation")
    with pytest.raises(PersistError, match=r"another evaluation .*autoguidance: None, now 2"):
        check_same(earlier, now | {"autoguidance": 2.0}, "runs/eval: holds another evaluation")
    with pytest.raises(PersistError, match=r"another evaluation .*voxel: 3a, now 4b"):
        check_same(settings, {"adapter_settings": {"voxel": "4b"}}, "runs/eval: holds another evaluation")


def test_a_key_that_is_there_without_a_value_is_named():
    with pytest.raises(PersistError, match=r"another evaluation .*seed: None, now None"):
        check_same({"steps": 4}, {"steps": 4, "seed": None}, "runs/eval: holds another evaluation")


def test_a_path_without_a_fingerprint_counts():
    with pytest.raises(PersistError, match="path: a, now b"):
        check_same({"path": "a"}, {"path": "b"}, "runs/eval: holds another evaluation")
