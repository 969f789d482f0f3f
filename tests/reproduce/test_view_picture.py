"""The picture of ``persist view`` that the documentation shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from persist_cli.errors import PersistError
from persist_cli.io.own_address import address_of
from persist_cli.reproduce import view_picture
from persist_cli.reproduce.pages import CHROMIUM
from persist_cli.reproduce.view_picture import take_picture
from persist_cli.viewer.page import Page
from persist_cli.viewer.page_server import page_server
from persist_cli.viewer.stage import Look
from persist_cli.viewer.subject import POINTS, open_subject

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


def test_the_picture_shows_the_page_after_what_was_pressed(
    walks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_picture, "STEADY", 200)
    subject = open_subject(f"{walks}#0:0-4")
    with page_server("127.0.0.1", 0) as server:
        Page(server, subject, Look(layers={POINTS}), None, None)
        address = address_of("127.0.0.1", server.get_port())
        take_picture(address, tmp_path / "view.png", ["Look"], (700, 500))
        with pytest.raises(PersistError, match="--press Edit: the page has no tab or button of this name"):
            take_picture(address, tmp_path / "none.png", ["Edit"], (700, 500))
    picture = Image.open(tmp_path / "view.png")
    assert picture.size == (700, 500)
    assert np.asarray(picture.convert("L").crop((0, 150, 350, 500))).std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["view.png"]
