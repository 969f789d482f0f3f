from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from persist_cli.errors import PersistError
from persist_cli.reproduce.commands import run_main
from persist_cli.reproduce.pages import CHROMIUM, served_page, split_arguments
from persist_cli.reproduce.play_picture import main, presses, take_picture
from tests.support.scripted_walks import ScriptedWalks, serving


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_picture_of_the_page_is_taken_after_a_walk(tmp_path: Path) -> None:
    walks = ScriptedWalks({"none": [np.full((16, 16, 3), 250, np.uint8)]})
    with serving(walks) as address:
        take_picture(address, tmp_path / "play.png", "a*2 w", (800, 600))
    picture = Image.open(tmp_path / "play.png")
    assert picture.size == (800, 600)
    assert len(picture.convert("L").getcolors() or []) > 10
    assert [message["held"] for message in walks.messages("keys", 4)] == [["left"], [], ["forward"], []]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_key_that_there_is_not_and_a_page_that_is_gone_are_told_in_one_line(tmp_path: Path) -> None:
    walks = ScriptedWalks({"none": [np.full((16, 16, 3), 250, np.uint8)]})
    with serving(walks) as address, pytest.raises(PersistError, match=r"^the browser says: .*Unknown key.*$"):
        take_picture(address, tmp_path / "play.png", "foo*3", (800, 600))
    with pytest.raises(PersistError, match=r"^the browser says: .*ERR_CONNECTION_REFUSED"):
        take_picture(address, tmp_path / "play.png", "a", (800, 600))
    assert list(tmp_path.iterdir()) == []


def test_a_walk_is_keys_and_frames() -> None:
    assert presses("a*4 w d*12") == [("a", 4), ("w", 1), ("d", 12)]


def test_what_follows_two_dashes_is_for_persist_play() -> None:
    own, passed = split_arguments(["play.png", "--walk", "a*3", "--", "--memories", "none", "--", "x"])
    assert own == ["play.png", "--walk", "a*3"]
    assert passed == ["--memories", "none", "--", "x"]
    assert split_arguments(["play.png"]) == (["play.png"], [])


@pytest.mark.parametrize(
    ("option", "message"),
    [("--walk=a*b", "as in 'a*4 w'"), ("--size=big", "as in 1360x800"), ("--size=0x9", "1360x800")],
)
def test_a_mistake_is_one_line(option: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["play_picture", "play.png", option])
    with pytest.raises(SystemExit, match=f"^error: .*{re.escape(message)}$"):  # Python prints it; the exit code is 1
        run_main(main)
    assert not Path("play.png").exists()


def test_a_command_that_serves_no_page_is_named_with_its_exit_code(capfd: pytest.CaptureFixture[str]) -> None:
    with (
        pytest.raises(PersistError, match=r"`persist nonsense` ended with exit code 2 and served no page"),
        served_page("nonsense"),
    ):
        pass
    assert "nonsense" in capfd.readouterr().err
