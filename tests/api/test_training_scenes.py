"""Names of training scenes are read back from JSON, which stores numbered names as ranges."""

from __future__ import annotations

import json

import pytest

from persist_cli.api.training_scenes import TrainingScenes, name_ranges

HOUSES = [f"miniworld/house-{number}" for number in range(2400)]

NAMES = [[], ["kitchen"], HOUSES, ["scene0000_00", "scene0000_01", "scene0001_00"], ["7", "8", "9", "10", "007", "008"],
         ["a", "a1", "b2", "b3", "a2b"], ["", "2", "٣"]]  # fmt: skip


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("complete", [True, False])
def test_scenes_are_read_back_from_json(names, complete):
    scenes = TrainingScenes(frozenset(names), complete)
    assert TrainingScenes.from_json(json.loads(json.dumps(scenes.to_json()))) == scenes


def test_numbered_scenes_become_one_range_for_each_number_of_digits():
    ends = [[0, 9], [10, 99], [100, 999], [1000, 2399]]
    assert name_ranges(HOUSES) == [[f"miniworld/house-{number}" for number in pair] for pair in ends]


def test_the_scenes_of_two_models_are_complete_only_when_those_of_both_are():
    a, b, unknown = TrainingScenes(frozenset("a")), TrainingScenes(frozenset("b")), TrainingScenes(complete=False)
    assert a | b == TrainingScenes(frozenset("ab"))
    assert a | unknown == TrainingScenes(frozenset("a"), complete=False)


@pytest.mark.parametrize(
    "value",
    [None, [], {}, {"complete": 1, "names": []}, {"complete": True, "names": [3]},
     {"complete": True, "names": [["a1"]]}, {"complete": True, "names": [["a1", "b2"]]}],
)  # fmt: skip
def test_json_that_is_no_list_of_scenes_is_an_error(value):
    with pytest.raises(ValueError, match="scene"):
        TrainingScenes.from_json(value)
