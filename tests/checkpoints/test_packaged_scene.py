"""The model of scenes that comes with the package is whole, small, and imagines rooms around one frame."""

from __future__ import annotations

from hashlib import sha256

import pytest
import torch

from persist_cli.api.cells import FREE, OUTSIDE, CellOrigin
from persist_cli.checkpoints.scene_models import PACKAGED, TrainedSceneModel, find_scene_model
from persist_cli.data.reference import parse_reference
from persist_cli.memorize.memory_file import load_memory

MOST_BYTES = 15e6


@pytest.fixture
def packaged(monkeypatch) -> TrainedSceneModel:
    """The one in the package; other tests have none, or use their own."""
    monkeypatch.delenv("PERSIST_REFERENCE")
    return find_scene_model(PACKAGED)


def test_every_file_has_its_hash_and_all_are_small(packaged):
    lines = [line.split("  ") for line in (packaged.folder / "SHA256SUMS").read_text().splitlines()]
    assert {name for _, name in lines} | {"SHA256SUMS", "README.md"} == {one.name for one in packaged.folder.iterdir()}
    for digest, name in lines:
        assert sha256((packaged.folder / name).read_bytes()).hexdigest() == digest, name
    assert sum((packaged.folder / name).stat().st_size for _, name in lines) <= MOST_BYTES


def test_it_was_not_trained_on_the_sample_houses(packaged):
    names = {parse_reference(text).single().info.scene for text in ("sample#0:0", "sample#1:0")}
    assert not any(name in packaged.training_scenes.names for name in names)


def test_one_frame_becomes_a_place_and_another_seed_another_one(packaged, persist, tmp_path):
    scenes = []
    for seed in (3, 4):
        out = tmp_path / f"{seed}.safetensors"
        ended = persist("memorize", "sample#0:0", "--model", PACKAGED, "--complete", "--seed", seed, "--out", out)
        assert ended.code == 0, ended.err
        scenes.append(load_memory(out).cells)
    one, other = scenes
    seen = one.origins == CellOrigin.OBSERVED
    assert torch.equal(seen, other.origins == CellOrigin.OBSERVED)
    assert torch.equal((one.classes == FREE)[seen], (other.classes == FREE)[seen])
    imagined = one.origins == CellOrigin.IMAGINED
    assert imagined.float().mean() > 0.9
    floor = one.form.palette.index("floor")
    lowest = one.classes[:, :, 0][imagined[:, :, 0]]
    inside = lowest != OUTSIDE
    assert inside.sum() > 50  # cells of ground, some three square metres
    assert (lowest[inside] == floor).float().mean() > 0.5
    assert not torch.equal(one.classes, other.classes)
