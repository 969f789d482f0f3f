"""A model that was trained on a part of a scene may be tested on the rest of it, and on nothing else of it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from persist_cli.data.held_out import trained_scene, was_trained_on
from tests.support.rooms import Room

ROOM = Room(32, 32).info


def test_a_part_of_a_scene_has_a_name_of_its_own() -> None:
    part = replace(ROOM, source={"only_before": 84})
    assert trained_scene(ROOM) == ROOM.scene
    assert trained_scene(part) == f"{ROOM.scene} before frame 84"


@pytest.mark.parametrize(("first", "trained"), [(84, False), (90, False), (83, True), (0, True)])
def test_frames_from_the_end_of_the_part_on_were_not_trained_on(first: int, trained: bool) -> None:
    assert was_trained_on(ROOM, [f"{ROOM.scene} before frame 84"], first) is trained


def test_a_whole_scene_and_another_one_are_what_they_are() -> None:
    assert was_trained_on(ROOM, [ROOM.scene], 500)
    assert not was_trained_on(ROOM, [f"{ROOM.scene}-2", f"{ROOM.scene}-2 before frame 84"])


def test_the_sequences_of_a_capture_are_parts_of_their_own() -> None:
    long, short = (replace(ROOM, source={"folder": name}) for name in ("seq-01", "seq-02"))
    parts = [
        trained_scene(replace(info, source=info.source | {"only_before": end}))
        for info, end in ((long, 35), (short, 21))
    ]
    assert parts == [f"{ROOM.scene} (seq-01) before frame 35", f"{ROOM.scene} (seq-02) before frame 21"]
    assert (was_trained_on(long, parts, 35), was_trained_on(long, parts, 34)) == (False, True)
    assert (was_trained_on(short, parts, 21), was_trained_on(short, parts, 20)) == (False, True)
    earlier = [f"{ROOM.scene} before frame 35"]
    assert (was_trained_on(short, earlier, 21), was_trained_on(short, earlier, 35)) == (True, False)
