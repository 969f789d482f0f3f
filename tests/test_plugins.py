"""Plugins from other packages: installed ones are used by name, and broken ones stop no others."""

from __future__ import annotations

import json

import pytest

from persist_cli.errors import PluginError
from persist_cli.plugins import list_plugins, load_plugin
from tests.support.micro_runs import stage
from tests.support.packages import install

LAST_FRAME = """
    import torch
    from persist_cli.api.memory import Memory
    from persist_cli.api.tokens import MemoryTokens

    class LastFrame(Memory):
        frame = torch.zeros(0)
        def write(self, observations): self.frame = self.encoder.encode(observations.rgb[-1:])[0].flatten(0, 1)
        def read(self, cameras, budget):
            features = self.frame[:budget].reshape(-1, self.encoder.channels)
            return MemoryTokens.of(features, cameras.centers[:1].expand(len(features), 3))
        def tensors(self): return {"frame": self.frame}
        def restore(self, tensors): self.frame = tensors.get("frame", torch.zeros(0))
"""


def test_a_memory_of_another_package_works_in_every_command_by_name(persist, site, walks, stage1, tmp_path):
    install(site, "persist-last", "persist.memories", "last = last_frame:LastFrame", LAST_FRAME)
    recipe = ("memory.name=last", f"base={stage1}")
    assert "persist-last" in persist("plugins").out
    assert persist("memorize", f"{walks}#0:0-5", "--memory", "last", "--out", tmp_path / "m.safetensors").code == 0
    assert persist(*stage("stage2-voxel", walks, tmp_path / "run", *recipe)).code == 0
    options = ["--start", f"{walks}#0:4", "--actions", "left", "--steps", 1]
    memory = ["--memory", tmp_path / "m.safetensors"]
    assert persist("rollout", tmp_path / "run", *options, *memory, "--out", tmp_path / "rollout").code == 0
    few = ["--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1, "--steps", 1]
    evaluated = persist("eval", tmp_path / "run", "--data", walks, "--memories", "last", *few, "--out", tmp_path / "e")
    assert (evaluated.code, "last" in evaluated.out) == (0, True)


def test_a_broken_plugin_shows_its_cause_and_stops_no_others(persist, site):
    install(site, "persist-broken", "persist.memories", "broken = broken_memory:Broken", "raise OSError('no such lib')")
    install(site, "persist-wrong", "persist.encoders", "wrong = wrong_kind:Wrong", "Wrong = dict")
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert rows["broken"]["state"] == "OSError: no such lib"
    assert "no subclass of persist_cli.api.encoder.Encoder" in rows["wrong"]["state"]
    assert rows["voxel"]["state"] == "ok"
    with pytest.raises(PluginError, match=r"memory 'broken' \(persist-broken 1\.2, broken_memory:Broken\) is broken"):
        load_plugin("memory", "broken")


def test_a_name_that_two_packages_claim_is_an_error_that_names_both(persist, site):
    install(site, "persist-other", "persist.memories", "voxel = other_voxel:Voxel", "")
    with pytest.raises(PluginError, match="memory 'voxel' is claimed by persist-cli and persist-other"):
        load_plugin("memory", "voxel")
    assert "claimed by 2 packages" in persist("plugins").out


def test_an_unknown_plugin_is_an_error_with_the_nearest_name():
    with pytest.raises(PluginError, match="unknown memory 'voxle'; did you mean 'voxel'"):
        load_plugin("memory", "voxle")
    with pytest.raises(PluginError, match="unknown importer 'zip'; installed: 7scenes"):
        load_plugin("importer", "zip")


def test_listing_imports_no_plugin(site):
    install(site, "persist-broken", "persist.simulators", "broken = not_there:Broken")
    assert "broken" in {plugin.name for plugin in list_plugins("simulator")}
