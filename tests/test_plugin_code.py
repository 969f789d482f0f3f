"""The code of other packages' plugins: figures and caches of an edited one are not those that it made before."""

from __future__ import annotations

import importlib
import shutil

import pytest

from persist_cli.checkpoints.scene_models import write_scene_card
from persist_cli.evaluate.provenance import adapter_plugins
from persist_cli.io.files import write_json
from persist_cli.plugin_code import code_json, code_of
from tests.support.micro_runs import stage
from tests.support.packages import LAST_FRAME, install


@pytest.fixture
def memory(site):
    """Installs a package with a memory ``last``; returns its folder."""
    install(site, "persist-last", "persist.memories", "last = remembering.frames.last:LastFrame")
    folder = site / "remembering"
    (folder / "frames").mkdir(parents=True)
    for file in ("__init__.py", "frames/__init__.py", "frames/last.py", "sizes.py"):
        (folder / file).touch()
    return folder


def test_a_package_is_told_by_any_of_its_modules_and_by_nothing_else(memory):
    before = code_of("memory", "last")
    assert before is not None
    assert before.startswith("persist-last 1.2, code ")
    (memory / "README.md").write_text("nothing that is run")
    (memory / "frames/__pycache__").mkdir()
    (memory / "frames/__pycache__/last.cpython-311.pyc").touch()
    (memory / "frames/.#last.py").symlink_to("somebody@here")  # as Emacs locks a file that is edited
    assert code_of("memory", "last") == before
    (memory / "sizes.py").write_text("SIZE = 2")
    after = code_of("memory", "last")
    assert after != before
    (memory / "sizes.py").rename(memory / "frames/sizes.py")
    assert code_of("memory", "last") not in (before, after)


def test_other_packages_of_a_namespace_and_other_modules_beside_one_do_not_count(memory, site):
    (memory / "__init__.py").unlink()
    before = code_of("memory", "last")
    (memory / "sizes.py").write_text("SIZE = 2")
    assert code_of("memory", "last") == before
    (memory / "frames/last.py").write_text("SIZE = 2")
    assert code_of("memory", "last") != before
    install(site, "persist-flat", "persist.encoders", "flat = flat_encoder:Flat", "SIZE = 1")
    before = code_of("encoder", "flat")
    (site / "other.py").write_text("SIZE = 2")
    assert code_of("encoder", "flat") == before
    (site / "flat_encoder.py").write_text("SIZE = 2")
    assert code_of("encoder", "flat") != before


def test_persists_own_plugins_are_told_by_their_version_alone(memory):
    assert code_of("memory", "voxel") is None
    assert code_json(("memory", "voxel"), ("encoder", "patches")) == {}
    others = code_json(("memory", "voxel"), ("memory", "last"), ("encoder", "gone"))
    assert others == {"code": {"memory last": code_of("memory", "last"), "encoder gone": "not installed"}}


def test_a_plugin_whose_module_is_gone_is_told_by_its_package_alone(memory, site):
    shutil.rmtree(memory)
    importlib.invalidate_caches()
    assert (code_of("memory", "last") or "").startswith("persist-last 1.2, code ")


def test_an_adapter_depends_on_the_model_that_imagines_in_its_scenes(site, tmp_path):
    install(site, "persist-dreams", "persist.scene_models", "dreams = dreaming:Dreams", "SIZE = 1")
    write_json(tmp_path / "memory.json", {"name": "scene", "settings": {"model": str(tmp_path)}})
    plugins = adapter_plugins(tmp_path)  # there is no such model
    write_scene_card(tmp_path, "dreams", {}, "scene", None)
    assert adapter_plugins(tmp_path) == [*plugins, ("scene model", "dreams")]


def test_an_evaluation_does_not_go_on_with_an_edited_memory(persist, site, walks, held_out, stage1, tmp_path):
    install(site, "persist-last", "persist.memories", "last = evaluated_frame:LastFrame", LAST_FRAME)
    assert persist(*stage("stage2-voxel", walks, tmp_path / "run", "memory.name=last", f"base={stage1}")).code == 0
    few = ("--metrics", "psnr", "--controls", "", "--seeds", 1, "--clips", 1, "--steps", 1, "--out", tmp_path / "eval")
    command = ("eval", tmp_path / "run", "--data", held_out, "--memories", "last", *few)
    assert persist(*command).code == 0
    assert persist(*command).code == 0
    with (site / "evaluated_frame.py").open("a") as file:
        file.write("# a change\n")
    refused = persist(*command)
    assert (refused.code, len(refused.err.splitlines())) == (1, 1), refused.err
    assert "holds another evaluation (checkpoints 0 adapter_code last memory last: persist-last 1.2, c" in refused.err
