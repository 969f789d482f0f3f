"""Recordings lie under names that nobody can guess, and stay where the user says."""

from __future__ import annotations

import shutil

import pytest

from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.io.files import ASIDE
from persist_cli.play import recording
from persist_cli.play.recordings import ADDRESS, Recordings
from persist_cli.play.worker import Workers
from tests.support.micro_plays import micro_walks


@pytest.fixture(scope="module")
def walk(walks):
    return micro_walks(walks)


@pytest.fixture
def play(walk):
    """A walk of two steps that is being recorded."""
    play = walk()
    play.record()
    for _ in range(2):
        play.advance({"left"})
    return play


def test_recordings_without_a_folder_go_with_their_session(play):
    recordings = Recordings()
    shelf = recordings.shelf()
    saved = shelf.save(play)
    name = saved.video.removeprefix(ADDRESS)
    assert recordings.find(name).path.is_file()
    shelf.clear(play)
    assert recordings.find(name) is None
    assert not [*recordings.folder.iterdir()]
    recordings.close()
    assert not recordings.folder.exists()


def test_a_walk_that_ends_while_it_is_recorded_is_saved_in_the_folder(play, tmp_path):
    recordings = Recordings(tmp_path)
    recordings.shelf().clear(play)
    recordings.close()
    [folder] = tmp_path.iterdir()
    assert len(Store(folder / "data")[0].read()) == 3


def test_a_recording_is_in_the_folder_whole_or_not_at_all(play, tmp_path, monkeypatch):
    archive, present = shutil.make_archive, []

    def look(*arguments):
        present.extend(path.name for path in tmp_path.iterdir())
        return archive(*arguments)

    monkeypatch.setattr(shutil, "make_archive", look)
    recorded = Recordings(tmp_path).shelf().save(play)
    assert [name.startswith(ASIDE) for name in present] == [True]
    [folder] = tmp_path.iterdir()
    assert str(folder) == recorded.folder
    assert sorted(path.name for path in folder.iterdir()) == ["data", "walk.mp4", "walk.zip"]


def test_a_full_recording_is_saved_when_its_walk_ends(play, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "LONGEST", 3)
    assert play.recording_is_full
    Recordings(tmp_path).shelf().clear(play)
    [folder] = tmp_path.iterdir()
    assert len(Store(folder / "data")[0].read()) == 3


def test_a_recording_that_is_saved_has_ended_and_is_not_saved_again(play, tmp_path):
    shelf = Recordings(tmp_path).shelf()
    shelf.save(play)
    assert not play.recording
    with pytest.raises(PersistError, match="nothing was recorded"):
        shelf.save(play)
    shelf.clear(play)
    assert len([*tmp_path.iterdir()]) == 1


def test_a_recording_that_cannot_be_saved_when_its_walk_ends_is_said_on_the_terminal(
    play, tmp_path, monkeypatch, capsys
):
    def no_room(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "make_archive", no_room)
    Recordings(tmp_path).shelf().clear(play)
    error = capsys.readouterr().err
    assert f"{tmp_path}: the recording of a walk that has ended is lost, not saved" in error
    assert "No space left on device" in error
    assert error.count("\n") == 1


def test_a_last_call_that_fails_is_said_on_the_terminal(capsys):
    workers = Workers()
    workers.give_last(lambda: 1 / 0)
    assert workers.close(60)
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_of_a_recording_that_cannot_be_saved_nothing_is_left(play, tmp_path, monkeypatch):
    def no_room(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "make_archive", no_room)
    shelf = Recordings(tmp_path).shelf()
    with pytest.raises(PersistError, match="No space left on device; make room there"):
        shelf.save(play)
    assert not [*tmp_path.iterdir()]
    monkeypatch.undo()
    assert play.recording
    assert shelf.save(play).frames == 3
