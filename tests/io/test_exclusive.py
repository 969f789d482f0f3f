"""A folder that one command at a time writes into."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from persist_cli.errors import PersistError
from persist_cli.io.exclusive import LOCK, exclusive

HOLD = """
import sys, time
from pathlib import Path
from persist_cli.io.exclusive import exclusive
with exclusive(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def elsewhere(tmp_path: Path):
    """Another process that has the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path / "run")], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_who_comes_second_is_refused_and_leaves_the_folder_as_it_is(elsewhere, tmp_path):
    folder = tmp_path / "run"
    (folder / "kept").touch()
    with (
        pytest.raises(PersistError, match=r"another command is writing there \(it has locked .*run/\.lock\); wait"),
        exclusive(folder),
    ):
        pytest.fail("two have it")
    assert {path.name for path in folder.iterdir()} == {"kept", LOCK}
    with exclusive(folder, main=False):  # the main process of this command has asked
        pass


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_a_process_that_was_killed_has_it_no_longer(elsewhere, tmp_path, end):
    elsewhere.send_signal(end)
    elsewhere.wait()
    with exclusive(tmp_path / "run"):
        pass


def test_a_folder_that_was_made_for_nothing_is_removed_again(tmp_path):
    with pytest.raises(ValueError, match="bad input"), exclusive(tmp_path / "runs" / "new"):
        raise ValueError("bad input")
    assert not list(tmp_path.iterdir())
    with exclusive(tmp_path / "runs" / "new"):
        (tmp_path / "runs" / "new" / "result").touch()
    assert [path.name for path in (tmp_path / "runs" / "new").iterdir()] == ["result"]
    (tmp_path / "empty").mkdir()
    with exclusive(tmp_path / "empty"):
        pass
    assert (tmp_path / "empty").is_dir()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
@pytest.mark.parametrize("code", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_where_the_file_system_has_no_locks_nobody_is_refused(tmp_path, monkeypatch, code):
    def flock(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", flock)
    with exclusive(tmp_path / "run"):
        assert not (tmp_path / "run" / LOCK).exists()  # nothing is left when this command is killed
        with exclusive(tmp_path / "run"):
            (tmp_path / "run" / "result").touch()
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["result"]
    with exclusive(tmp_path / "new"):
        pass
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "command",
    [
        "eval --data sample --seeds 1 --metrics psnr",
        "bench plan --scenes 0:1",
        "bench scene --data none",
        "learn --views sample#0:0-24",
        "finetune tiny-codec --data sample training.steps=2",
    ],
)
def test_commands_that_go_on_in_a_folder_have_it_alone(elsewhere, persist, tmp_path, command):
    refused = persist(*command.split(), "--out", tmp_path / "run")
    why = f"another command is writing there (it has locked {tmp_path}/run/{LOCK})"
    advice = "wait until it has ended, or choose another --out"
    assert (refused.code, refused.err) == (1, f"error: {tmp_path}/run: {why}; {advice}\n")
    assert [path.name for path in (tmp_path / "run").iterdir()] == [LOCK]


def test_another_users_lock_is_neither_ignored_nor_removed(elsewhere, tmp_path, monkeypatch):
    def refuse(self):
        raise PermissionError(13, "Permission denied", str(tmp_path / "run" / LOCK))

    monkeypatch.setattr("filelock.FileLock._acquire", refuse)
    with (
        pytest.raises(PersistError, match="another user's; wait until that command has ended"),
        exclusive(tmp_path / "run"),
    ):
        pytest.fail("two have it")
    assert (tmp_path / "run" / LOCK).exists()
