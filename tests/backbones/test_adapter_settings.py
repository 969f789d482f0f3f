"""Settings of adapters: each form has its own, and settings that cannot work are refused in one line."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.errors import CheckpointError, PersistError, RecipeError
from tests.support.micro_model import CHANNELS, micro, with_adapter

FORM_KEYS = {
    "cross": {"heads", "frequencies", "origins", "positions", "normalize", "key_positions", "key_camera",
              "ray_frequencies"},
    "projected": {"heads", "frequencies", "origins"},
    "canvas": {"origins", "canvas_channels", "canvas_scale", "token_size", "splat_pixels", "head_width"},
    "rendered": {
        "heads", "frequencies", "token_size", "splat_pixels", "hole_share", "thickness", "supersampling", "head_width",
        "head_layers", "attention_tokens", "layers", "classes", "class_channels", "layer_width", "layer_gap",
        "layer_scale", "color_error", "depth_error", "origins",
    },
    "frames": {"heads", "frequencies", "frame_patch"},
}  # fmt: skip
SHARED_KEYS = {
    "channels", "form", "every", "width", "ff_factor", "token_budget", "dropout", "learned_tokens", "noise",
}  # fmt: skip


Saved = Callable[[str], tuple[CogVideoX, Path]]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Saved:
    """A function that gives a backbone with an adapter of a form, and the folder that this was saved to."""

    @functools.cache
    def of(form: str) -> tuple[CogVideoX, Path]:
        backbone, folder = with_adapter(micro(), form=form), tmp_path_factory.mktemp(form)
        backbone.save_adapter(folder)
        return backbone, folder

    return of


@pytest.mark.parametrize("form", FORM_KEYS)
def test_every_adapter_form_has_exactly_the_settings_that_it_uses(form: str, saved: Saved) -> None:
    assert set(json.loads((saved(form)[1] / "adapter.json").read_text())) == SHARED_KEYS | FORM_KEYS[form]


@pytest.mark.parametrize(
    ("form", "key"),
    [(form, key) for form in FORM_KEYS for key in sorted(set().union(*FORM_KEYS.values()) - FORM_KEYS[form])],
)
def test_a_setting_of_another_form_is_refused(form: str, key: str, saved: Saved, tmp_path: Path) -> None:
    backbone, folder = saved(form)
    with pytest.raises(RecipeError, match=f"^adapter 'other': unknown key '{key}'"):
        backbone.add_adapter("other", CHANNELS, {"form": form, key: 1})
    card = shutil.copytree(folder, tmp_path / "adapter") / "adapter.json"
    card.write_text(json.dumps(json.loads(card.read_text()) | {key: 1}))
    with pytest.raises(RecipeError, match=f"adapter.json: unknown key '{key}'"):
        backbone.load_adapter("other", card.parent)


@pytest.mark.parametrize(
    ("settings", "cause"),
    [
        ({"dropout": 1.5}, "dropout must be .*at most 1, not 1.5"),
        ({"dropout": -0.1}, "dropout must be .*at least 0 .*not -0.1"),
        ({"token_budget": 0}, "token_budget must be a whole number above 0"),
        ({"ff_factor": -1}, "ff_factor must be a number above 0"),
        ({"form": "cross", "ff_factor": 0}, "ff_factor must be a number above 0"),
        ({"form": "canvas", "ff_factor": -1}, "ff_factor must be a number of at least 0"),
        ({"width": 16, "heads": 3}, "3 heads do not divide a width of 16"),
        ({"form": "projected", "width": 16, "heads": 5}, "5 heads do not divide a width of 16"),
        ({"every": 3}, "every is 3, but the model has 2 layers"),
        ({"form": "canvas", "every": 3}, "every is 3, but the model has 2 layers"),
        ({"form": "canvas", "splat_pixels": 4}, "splat_pixels must be odd, not 4"),
        ({"form": "splat"}, "unknown adapter form 'splat'; known: cross, projected, canvas, rendered, frames"),
    ],
)
def test_adapter_settings_that_cannot_work_are_refused(settings: dict, cause: str) -> None:
    with pytest.raises(PersistError, match=cause) as error:
        micro().add_adapter("other", CHANNELS, settings)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("card", ["[]", "{}", '{"channels": "many"}'])
def test_a_damaged_adapter_card_is_refused(card: str, tmp_path: Path) -> None:
    backbone = with_adapter(micro())
    backbone.save_adapter(tmp_path)
    (tmp_path / "adapter.json").write_text(card)
    with pytest.raises(CheckpointError, match=r"adapter.json: not the card of an adapter$"):
        backbone.load_adapter("other", tmp_path)
