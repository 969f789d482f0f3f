"""The memory keeps the frame seen last, and what it saves it also restores."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Observations, Origin
from persist_cli.data.reference import parse_reference
from persist_cli.errors import CheckpointError
from persist_cli.memorize.memory_file import load_memory
from persist_cli.plugins import make_encoder, make_memory
from persist_last_frame import LastFrame, LastFrameSettings


@pytest.fixture
def frames() -> Observations:
    return parse_reference("sample#0:0-4").read()[0].observations


def empty(most: int = 64) -> LastFrame:
    encoder = make_encoder("patches", {"patch": 8, "channels": 6})
    return LastFrame(LastFrameSettings(most), encoder, FrameOfReference("house"))


def test_only_the_last_frame_is_read(frames: Observations) -> None:
    all_of_them, last = empty(), empty()
    all_of_them.write(frames)
    last.write(frames[-1:])
    one, other = (memory.read(frames.cameras, 100) for memory in (all_of_them, last))
    assert len(one) == 64
    assert torch.equal(one.features, other.features)
    assert torch.equal(one.positions[0], frames.cameras.centers[-1])


def test_an_imagined_frame_does_not_replace_an_observed_one(frames: Observations) -> None:
    memory = empty()
    memory.write(frames[:1])
    memory.write(frames[1:].with_origin(Origin.IMAGINED))
    assert torch.equal(memory.read(frames.cameras, 1).positions[0], frames.cameras.centers[0])


def test_no_more_tokens_are_read_than_the_budget_and_the_setting_allow(frames: Observations) -> None:
    memory = empty(most=10)
    memory.write(frames)
    assert [len(memory.read(frames.cameras, budget)) for budget in (0, 4, 100)] == [0, 4, 10]


def test_an_emptied_memory_gives_no_token(frames: Observations) -> None:
    memory = empty()
    memory.write(frames)
    memory.clear()
    assert (len(memory.read(frames.cameras, 100)), memory.tensors()) == (0, {})


def test_a_saved_memory_is_read_as_it_was_written(frames: Observations, tmp_path: Path) -> None:
    memory = make_memory("last", {"most": 9}, empty().encoder, FrameOfReference("house"))
    memory.write(frames)
    memory.save(tmp_path / "last.safetensors")
    again = load_memory(tmp_path / "last.safetensors")
    for path in (frames.cameras[:1], frames.cameras):
        assert torch.equal(again.read(path, 100).features, memory.read(path, 100).features)
        assert torch.equal(again.read(path, 100).positions, memory.read(path, 100).positions)


def test_what_is_written_into_a_copy_does_not_change_the_memory(frames: Observations) -> None:
    memory = empty()
    memory.write(frames[:1])
    before = memory.read(frames.cameras, 100).features.clone()
    memory.copy().write(frames[1:])
    assert torch.equal(memory.read(frames.cameras, 100).features, before)


def test_a_copy_reads_the_same_and_foreign_tensors_are_refused(frames: Observations) -> None:
    memory = empty()
    memory.write(frames)
    assert torch.equal(memory.copy().read(frames.cameras, 9).features, memory.read(frames.cameras, 9).features)
    with pytest.raises(CheckpointError, match="wanted are center, features, origin"):
        memory.restore({"voxels": torch.zeros(1)})
