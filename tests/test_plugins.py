"""Plugins from other packages: installed ones are used by name, and broken ones stop no others."""

from __future__ import annotations

import json
import re
import textwrap

import pytest

from persist_cli.errors import PluginError
from persist_cli.plugins import list_plugins, load_plugin, plugin_errors
from tests.support.micro_runs import stage
from tests.support.packages import LAST_FRAME, install


def test_a_memory_of_another_package_works_in_every_command_by_name(persist, site, walks, held_out, stage1, tmp_path):
    install(site, "persist-last", "persist.memories", "last = last_frame:LastFrame", LAST_FRAME)
    recipe = ("memory.name=last", f"base={stage1}")
    assert "persist-last" in persist("plugins").out
    assert persist("memorize", f"{walks}#0:0-5", "--memory", "last", "--out", tmp_path / "m.safetensors").code == 0
    assert persist(*stage("stage2-voxel", walks, tmp_path / "run", *recipe)).code == 0
    options = ["--start", f"{walks}#0:4", "--actions", "left", "--steps", 1]
    memory = ["--memory", tmp_path / "m.safetensors"]
    assert persist("rollout", tmp_path / "run", *options, *memory, "--out", tmp_path / "rollout").code == 0
    few = ["--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1, "--steps", 1]
    evaluated = persist(
        "eval", tmp_path / "run", "--data", held_out, "--memories", "last", *few, "--out", tmp_path / "e"
    )
    assert (evaluated.code, "last" in evaluated.out) == (0, True)


def test_the_settings_of_a_memory_of_another_package_are_shown_in_a_recipe(persist, site, tmp_path):
    settings = """
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class LastSettings:
        \"\"\"Settings.

        Args:
            decay: share that is forgotten in a second.
        \"\"\"

        decay: float = 0.5
        untold: int = 3
    """
    code = settings + LAST_FRAME.replace("frame = torch", "settings_type = LastSettings\n        frame = torch", 1)
    install(site, "persist-last", "persist.memories", "last = told_frame:LastFrame", code)
    (tmp_path / "a.yaml").write_text("extends: tiny-stage2-voxel\nmemory: {name: last, settings: {decay: 0.9}}\n")
    text = persist("recipes", tmp_path / "a.yaml").out
    assert "    # share that is forgotten in a second; a number; default 0.5\n    decay: 0.9\n" in text
    assert "    # a whole number\n    #untold: 3\n" in text


def test_a_broken_plugin_shows_its_cause_and_stops_no_others(persist, site):
    install(site, "persist-broken", "persist.memories", "broken = broken_memory:Broken", "raise OSError('no such lib')")
    install(site, "persist-wrong", "persist.encoders", "wrong = wrong_kind:Wrong", "Wrong = dict")
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert rows["broken"]["state"] == "OSError: no such lib"
    assert "no subclass of persist_cli.api.encoder.Encoder" in rows["wrong"]["state"]
    assert rows["voxel"]["state"] == "ok"
    with pytest.raises(PluginError, match=r"memory 'broken' \(persist-broken 1\.2, broken_memory:Broken\) is broken"):
        load_plugin("memory", "broken")


RAISING = """
    from persist_cli.api.cost import Cost

    class Raising(Cost):
        def measure(self, futures, goal, ground): pass
        @classmethod
        def missing(cls): raise OSError("no such lib")
"""


def test_a_plugin_that_cannot_say_what_is_missing_stops_no_others(persist, site):
    install(site, "persist-raising", "persist.costs", "raising = raising_cost:Raising", RAISING)
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert rows["raising"]["state"] == "its missing() raised OSError: no such lib"
    assert rows["voxel"]["state"] == "ok"


def test_a_plugin_that_ends_the_process_is_shown_as_broken_and_stops_no_others(persist, site, walks, tmp_path):
    install(site, "persist-ending", "persist.encoders", "ending = ending_encoder:Ending", "raise SystemExit(0)")
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert (rows["ending"]["state"], rows["voxel"]["state"]) == ("SystemExit: 0", "ok")
    writing = "self.frame = self.encoder.encode(observations.rgb[-1:])[0].flatten(0, 1)"
    code = LAST_FRAME.replace(writing, "raise SystemExit(0)")
    install(site, "persist-last", "persist.memories", "last = ending_frame:LastFrame", code)
    ended = persist("memorize", f"{walks}#0:0-3", "--memory", "last", "--out", tmp_path / "m.safetensors")
    assert (ended.code, len(ended.err.splitlines())) == (1, 1)
    assert "failed in LastFrame.write: SystemExit: 0" in ended.err


SETTINGS = """
    from dataclasses import dataclass
    from enum import Enum
    import torch
    from persist_cli.api.encoder import Encoder

    class Colour(Enum):
        RED = 1

    @dataclass(frozen=True)
    class Settings:
        value: {kind} = {value}

    class Mine(Encoder):
        settings_type = Settings
        channels = 3
        def encode(self, rgb): return rgb.float()
"""


@pytest.mark.parametrize(
    ("kind", "value", "cause"),
    [
        ("Colour", "Colour.RED", "not JSON serializable"),
        ("torch.dtype", "torch.float32", "its settings cannot be used"),
        ("int", "'x'", "its settings cannot be read again: value must be a whole number, not 'x'"),
    ],
)
def test_settings_that_nothing_can_keep_are_refused_before_any_work(persist, site, walks, kind, value, cause):
    code = SETTINGS.format(kind=kind, value=value)
    install(site, "persist-mine", "persist.encoders", f"mine = mine_{kind[:5].lower()}:Mine", code)
    ended = persist("memorize", f"{walks}#0:0-3", "--encoder", "mine", "--out", site / "m.safetensors")
    assert (ended.code, len(ended.err.splitlines()), (site / "m.safetensors").exists()) == (1, 1, False)
    assert "encoder 'mine' (persist-mine 1.2, " in ended.err
    assert cause in ended.err
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert cause in rows["mine"]["state"]


def test_settings_of_an_unknown_type_are_one_line_where_a_recipe_is_shown(persist, site, tmp_path):
    install(
        site, "persist-mine", "persist.encoders", "mine = mine_ahead:Mine", SETTINGS.format(kind="'Later'", value=3)
    )
    (tmp_path / "a.yaml").write_text("extends: tiny-stage2-voxel\nmemory: {encoder: mine}\n")
    ended = persist("recipes", tmp_path / "a.yaml")
    assert (ended.code, len(ended.err.splitlines())) == (1, 1)
    assert "mine_ahead:Mine) is broken: its settings cannot be used: " in ended.err


def test_two_names_of_one_class_are_refused(site):
    code = SETTINGS.format(kind="int", value=3)
    install(site, "persist-mine", "persist.encoders", "mine = mine_twice:Mine\nalias = mine_twice:Mine", code)
    load_plugin("encoder", "mine")
    with pytest.raises(PluginError, match=r"its class is that of 'mine' too; each name needs one of its own"):
        load_plugin("encoder", "alias")


def test_settings_that_fail_name_the_plugin_that_was_asked_for(persist, site, walks):
    code = SETTINGS.format(kind="int", value=3).replace(
        "value: int = 3", "value: int = 3\n        def __post_init__(self): raise OSError('no lib')"
    )
    entries = "mine = mine_post:Mine\nother = mine_post:Other"
    install(site, "persist-mine", "persist.encoders", entries, code + "\n    class Other(Mine): pass\n")
    ended = persist("memorize", f"{walks}#0:0-3", "--encoder", "other", "--out", site / "m.safetensors")
    assert (ended.code, len(ended.err.splitlines())) == (1, 1)
    assert (
        "encoder 'other' (persist-mine 1.2, mine_post:Other) is broken: its settings cannot be used: OSError"
        in ended.err
    )


UNFINISHED = """
    from dataclasses import dataclass
    from persist_cli.api.memory import Memory
    from persist_cli.api.encoder import Encoder
    from persist_cli.api.simulator import Simulator

    class Unfinished(Memory):
        def read(self, cameras, budget): pass
        def tensors(self): return {}

    class Alone(Unfinished):
        def write(self, observations): pass
        def restore(self, tensors): pass
        def __init__(self, settings): pass

    class Unset(Encoder):
        settings_type = dict
        channels = 3
        def encode(self, rgb): pass

    def function(settings, encoder, reference): pass

    class Short(Alone):
        def __init__(self, *parts): pass
        def read(self, cameras): pass

    class Optional(Short):
        def read(self, cameras, budget, more=0): pass
        def edit(self, *edits): pass
        @staticmethod
        def resolution(cameras, distance=1.0): pass
        reads_depth = property(lambda self: False)

    class Hidden(Optional):
        reads_depth = "no"

    class Method(Unset):
        settings_type = Memory.settings_type
        def channels(self): return 3

    class Missing(Simulator):
        agent = bounds = info = None
        open_scene = place = observe = act = is_free = ahead = lambda self, *parts: None
        def missing(self): return ""
"""


@pytest.mark.parametrize(
    ("kind", "name", "cause"),
    [("memory", "Unfinished", "it lacks restore, write, which Memory leaves to its subclasses"),
     ("memory", "Alone", "its __init__ does not take (settings, encoder, reference)"),
     ("encoder", "Unset", "its settings_type is no dataclass"),
     ("memory", "Short", "its read does not take (cameras, budget)"),
     ("memory", "Hidden", "its reads_depth is 'no', no bool"),
     ("encoder", "Method", "its channels is a plain method; write @property above it"),
     ("memory", "function", "it is no subclass of persist_cli.api.memory.Memory"),
     ("memory", "Absent", "AttributeError: module 'unfinished' has no attribute 'Absent'")],
)  # fmt: skip
def test_an_unfinished_plugin_is_shown_as_broken_and_refused_in_one_line(persist, site, walks, kind, name, cause):
    group = {"memory": "persist.memories", "encoder": "persist.encoders"}[kind]
    install(site, "persist-unfinished", group, f"unfinished = unfinished:{name}", UNFINISHED)
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert rows["unfinished"]["state"] == cause
    ended = persist("memorize", f"{walks}#0:0-3", f"--{kind}", "unfinished", "--out", site / "m.safetensors")
    line = f"error: {kind} 'unfinished' (persist-unfinished 1.2, unfinished:{name}) is broken: {cause}"
    assert (ended.code, ended.err.splitlines()) == (1, [line])
    with pytest.raises(PluginError) as error:
        load_plugin(kind, "unfinished")
    assert (error.value.package, error.value.cause) == ("persist-unfinished", cause)


def test_a_method_that_asks_the_class_has_to_be_one_of_the_class(site):
    install(site, "persist-unfinished", "persist.simulators", "unfinished = unfinished:Missing", UNFINISHED)
    with pytest.raises(PluginError, match="is broken: its missing is a plain method; write @classmethod above it"):
        load_plugin("simulator", "unfinished")


def test_a_method_that_takes_more_than_it_is_given_can_be_used(site):
    install(site, "persist-unfinished", "persist.memories", "unfinished = unfinished:Optional", UNFINISHED)
    assert load_plugin("memory", "unfinished").name == "unfinished"


@pytest.mark.parametrize("target", ["unfinished", "unfinished:"])
def test_an_entry_point_without_a_class_is_said_to_need_one(persist, site, target):
    install(site, "persist-unfinished", "persist.memories", f"unfinished = {target}", UNFINISHED)
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    assert rows["unfinished"]["state"] == "its entry point names no class; write module:class"


def test_every_plugin_of_persist_can_be_used(persist):
    rows = json.loads(persist("plugins", "--json").out)
    unusable = [row for row in rows if row["state"] != "ok"]
    assert all(row["kind"] == "cost" and "persist weights fetch" in row["state"] for row in unusable)


def test_an_exception_in_a_plugin_is_one_line_that_says_where(persist, site, walks, monkeypatch):
    code = LAST_FRAME.replace("self.frame = self.encoder.encode(observations.rgb[-1:])", "self.frame = [][2]")
    install(site, "persist-last", "persist.memories", "last = failing_frame:LastFrame", code)
    arguments = ["memorize", f"{walks}#0:0-3", "--memory", "last", "--out", site / "m.safetensors"]
    ended = persist(*arguments)
    cause = f"IndexError: list index out of range ({site / 'failing_frame.py'}:8)"
    line = f"memory 'last' (persist-last 1.2, failing_frame:LastFrame) failed in LastFrame.write: {cause}; set "
    assert (ended.code, ended.err.splitlines()) == (1, [f"error: {line}PERSIST_TRACEBACK=1 for the whole traceback"])
    monkeypatch.setenv("PERSIST_TRACEBACK", "1")
    assert "Traceback" in persist(*arguments).err


ENCODER = """
    from persist_cli.api.encoder import Encoder
    class Failing(Encoder):
        channels = 3
        def encode(self, rgb): return rgb.gray()
"""


def test_an_encoder_that_fails_within_a_memory_of_another_package_is_named_itself(persist, site, walks):
    install(site, "persist-last", "persist.memories", "last = calling_frame:LastFrame", LAST_FRAME)
    install(site, "persist-gray", "persist.encoders", "gray = failing_encoder:Failing", ENCODER)
    ended = persist(
        "memorize", f"{walks}#0:0-3", "--memory", "last", "--encoder", "gray", "--out", site / "m.safetensors"
    )
    line = "error: encoder 'gray' (persist-gray 1.2, failing_encoder:Failing) failed in Failing.encode, called in "
    assert (ended.code, ended.err.startswith(f"{line}LastFrame.write: AttributeError")) == (1, True)


def test_a_plugin_that_inherits_its_method_from_another_one_is_named_itself(persist, site, walks):
    install(site, "persist-last", "persist.memories", "last = parent_frame:LastFrame", LAST_FRAME)
    child = "import parent_frame\nclass Child(parent_frame.LastFrame):\n    def __init__(self, *parts): pass\n"
    install(site, "persist-child", "persist.memories", "child = child_frame:Child", child)
    ended = persist("memorize", f"{walks}#0:0-3", "--memory", "child", "--out", site / "m.safetensors")
    assert "memory 'child' (persist-child 1.2, child_frame:Child) failed in LastFrame.write: AttributeErr" in ended.err


@pytest.mark.parametrize(
    ("method", "cause"),
    [
        ("def restore(self, tensors): pass", "restore made 0 items .* of what tensors gave, which was 16 items .*"),
        ("def copy(self): return self", "copy gave itself, not another memory"),
        ("def tensors(self): return None", "tensors gave None, not tensors by name"),
        ("def points(self): return (), ()", "points gave a tuple, not MapPoints"),
        ("def copy(self): pass", "copy gave NoneType, not another memory"),
    ],
)
def test_a_memory_that_could_not_be_read_again_ends_memorize_at_once(persist, site, walks, method, cause):
    code = LAST_FRAME + f"\n    class Mine(LastFrame):\n        {method}\n"
    module = f"mine_{len(method)}"
    install(site, "persist-mine", "persist.memories", f"mine = {module}:Mine", code)
    ended = persist("memorize", f"{walks}#0:0-3", "--memory", "mine", "--out", site / "m.safetensors")
    assert (ended.code, (site / "m.safetensors").exists()) == (1, False)
    assert re.match(f"error: memory 'mine': {cause}\n$", ended.err)


def test_an_error_of_several_lines_is_printed_in_one(persist, site, walks):
    writing = "self.frame = self.encoder.encode(observations.rgb[-1:])[0].flatten(0, 1)"
    told = "from persist_cli.errors import DataError; raise DataError('no\\nframe')"
    install(site, "persist-last", "persist.memories", "last = lines_frame:LastFrame", LAST_FRAME.replace(writing, told))
    ended = persist("memorize", f"{walks}#0:0-3", "--memory", "last", "--out", site / "m.safetensors")
    assert (ended.code, ended.err) == (1, "error: no frame\n")


def test_an_exception_that_passed_through_no_plugin_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError), plugin_errors():
        _ = 1 / 0


def test_an_exception_in_a_simulator_comes_back_from_its_process_in_one_line(persist, site, tmp_path, monkeypatch):
    code = """
        from persist_cli.api.simulator import Simulator
        class Flat(Simulator):
            agent = bounds = info = None
            def open_scene(self, scene): raise KeyError(scene)
            def place(self, ground, heading): pass
            def observe(self): pass
            def act(self, action): pass
            def is_free(self, ground): pass
            def ahead(self, heading): pass
    """
    install(site, "persist-flat", "persist.simulators", "flat = flat_world:Flat", code)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=":")
    ended = persist("collect", "flat", "--scenes", "7:8", "--out", tmp_path / "houses")
    line = "error: simulator 'flat' (persist-flat 1.2, flat_world:Flat) failed in Flat.open_scene: KeyError: 7 ("
    *progress, last = ended.err.splitlines()  # a process may take so long to start that the command says so
    assert (ended.code, last.startswith(line)) == (1, True)
    assert all(told.startswith("collect: ") for told in progress)


def test_a_name_that_two_packages_claim_is_an_error_that_names_both(persist, site):
    install(site, "persist-other", "persist.memories", "voxel = other_voxel:Voxel", "")
    claimed = "^memory 'voxel' is claimed by persist-cli and persist-other; uninstall persist-other$"
    with pytest.raises(PluginError, match=claimed):
        load_plugin("memory", "voxel")
    assert "claimed by 2 packages" in persist("plugins").out


@pytest.mark.parametrize("name", ["l/slash", "one,two", "two words", ".hidden", "stage1", "simulator"])
def test_a_name_that_cannot_be_a_folder_or_means_something_else_is_refused(site, name):
    install(site, "persist-last", "persist.memories", f"{name} = named_frame:LastFrame", LAST_FRAME)
    with pytest.raises(PluginError, match=r"is broken: (a|its) name has"):
        load_plugin("memory", name)


def test_what_a_plugin_prints_when_it_is_imported_is_not_the_output_of_the_command(persist, site):
    code = "print('noise')\n" + textwrap.dedent(LAST_FRAME)
    install(site, "persist-last", "persist.memories", "last = noisy_frame:LastFrame", code)
    shown = persist("plugins", "--json")
    assert {row["name"]: row for row in json.loads(shown.out)}["last"]["state"] == "ok"
    assert "noise" in shown.err


def test_an_entry_point_of_a_misspelt_group_is_shown_and_named(persist, site):
    install(site, "persist-last", "persist.memory", "last = group_frame:LastFrame", LAST_FRAME)
    rows = {row["name"]: row for row in json.loads(persist("plugins", "--json").out)}
    cause = "there is no group 'persist.memory'; did you mean 'persist.memories'?"
    assert (rows["last"]["kind"], rows["last"]["state"], rows["voxel"]["state"]) == ("persist.memory", cause, "ok")
    with pytest.raises(PluginError, match=r"^persist-last 1\.2 has no memory 'last': there is no group 'persist\.mem"):
        load_plugin("memory", "last")


def test_an_unknown_plugin_is_an_error_with_the_nearest_name():
    with pytest.raises(PluginError, match="unknown memory 'voxle'; did you mean 'voxel'"):
        load_plugin("memory", "voxle")
    with pytest.raises(PluginError, match="unknown importer 'zip'; installed: 7scenes"):
        load_plugin("importer", "zip")


def test_listing_imports_no_plugin(site):
    install(site, "persist-broken", "persist.simulators", "broken = not_there:Broken")
    assert "broken" in {plugin.name for plugin in list_plugins("simulator")}
