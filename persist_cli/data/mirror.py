"""Data sets at an address, as ``https://…``, ``hf://…`` or ``s3://…``: a folder of this machine mirrors what is read.

The folder lists the trajectories of the address and holds the ends of their files, which say length, camera and scene.
A trajectory is fetched whole when its frames are first read, and stays, so that each machine of a training fetches
what its processes read. fsspec speaks to the server.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import unquote

from persist_cli.data.parquet import SUFFIX
from persist_cli.errors import DataError
from persist_cli.io.exclusive import LOCK
from persist_cli.io.files import ASIDE, read_json, write_json, written_aside
from persist_cli.io.hub import cache_home
from persist_cli.output.console import add_task, busy, progress, warn

Result = TypeVar("Result")

ADDRESS: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://.")

LIST: Final = "mirror.json"  # in a mirror: its address, and what is there
HEADERS: Final = "headers"  # in a mirror: the ends of files that are not fetched yet

END: Final = 2**16  # bytes of a file's end that are read at first; they hold the header of some hundred frames
MAGIC: Final = b"PAR1"  # begins and ends a Parquet file
FOOTER: Final = 8  # bytes behind a header: its length, and ``MAGIC``

AT_ONCE: Final = 16  # files that are asked for at once
WAITS: Final = (1.0, 4.0)  # seconds before each new try of a web server; other clients try anew themselves

FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk is full, or the file too large for it

VERSIONS: Final = (  # of file systems; many web servers tell the time of the last change alone
    "ETag", "etag", "blob_id", "md5Hash", "LastModified", "last_modified", "Last-Modified", "mtime",
)  # fmt: skip


@dataclass(frozen=True)
class RemoteFile:
    """A file at an address.

    Args:
        place: its name in fsspec's file system.
        size: bytes.
        version: what changes when the file does, as far as the server says.
    """

    place: str
    size: int
    version: str


def is_address(text: str) -> bool:
    """Whether a data set's name is an address, and no folder of this machine."""
    return ADDRESS.match(text) is not None


@functools.cache
def mirror(address: str) -> Path:
    """The folder that mirrors an address, listed and with all headers; a process asks once what is there.

    Where the address is not in reach, what is known of it from before is used, and a line says so.

    Raises:
        DataError: naming the address, when it is not known and cannot be listed, or has no trajectory.
    """
    digest = hashlib.sha256(address.encode()).hexdigest()[:12]
    name = re.sub(r"[^A-Za-z0-9._-]", "-", address.rstrip("/").rpartition("/")[2])[-60:]
    folder = cache_home() / "data" / f"{name}-{digest}"
    known = mirrored(folder)
    try:
        files = _list(address)
    except DataError as error:
        if known is None:
            raise
        warn(f"{error}; what is known of it from before is used ({folder})")
        files = known
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _alone(address, folder):
            _keep(address, folder, files)
            _bring_headers(address, folder, files)
    except OSError as error:
        raise DataError(f"{folder}: nothing of {address} can be kept there ({error.strerror})") from error
    return folder


def mirrored(folder: Path) -> dict[str, RemoteFile] | None:
    """The files of a mirror's address by their names here, in order; ``None`` for a folder that is no mirror."""
    path = folder / LIST
    return _listed(path, path.stat().st_mtime_ns)[1] if path.is_file() else None


def address_of(folder: Path) -> str | None:
    """The address that a folder mirrors; ``None`` for a folder that is no mirror."""
    path = folder / LIST
    return _listed(path, path.stat().st_mtime_ns)[0] if path.is_file() else None


def header(path: Path) -> Path:
    """The file that holds a trajectory's header: itself, or only its end when the rest is not here."""
    end = path.parent / HEADERS / path.name
    return end if not path.is_file() and end.is_file() else path


def file_size(path: Path) -> int:
    """The bytes of a trajectory's file, wherever it is."""
    file = None if path.is_file() else (mirrored(path.parent) or {}).get(path.name)
    return path.stat().st_size if file is None else file.size


def fetched(path: Path) -> Path:
    """The file of a trajectory; it is fetched first when it is one of a mirror and not here yet.

    Raises:
        DataError: naming the address, when it cannot be fetched, or is not what was listed.
    """
    file = None if path.is_file() else (mirrored(path.parent) or {}).get(path.name)
    if file is None:
        return path
    with _address_errors(file.place):
        system, _ = _file_system(str(address_of(path.parent)))
        try:
            with written_aside(path) as aside:
                _tried(file.place, lambda: system.get_file(file.place, str(aside)))
                if aside.stat().st_size != file.size:
                    raise DataError(
                        f"{file.place}: {aside.stat().st_size} bytes came, {file.size} were listed; try again"
                    )
        except OSError as error:
            if error.errno not in FULL and not str(error.filename).startswith(str(path.parent)):
                raise  # of the server
            raise DataError(f"{path}: cannot be written ({error.strerror})") from error
    return path


@contextlib.contextmanager
def _alone(address: str, folder: Path) -> Iterator[None]:
    """Within the block no other process lists the address, where the file system of the mirror has locks."""
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK, fallback_to_soft=False)  # a soft one outlives a process that is killed
    try:
        lock.acquire(timeout=0)
    except Timeout:
        with busy(f"waiting for another process that lists {address} (it has locked {folder / LOCK})"):
            lock.acquire()
    except OSError:
        pass  # the file system has no locks
    try:
        yield
    finally:
        lock.release()


def _keep(address: str, folder: Path, files: dict[str, RemoteFile]) -> None:
    """Keep what is listed at an address; what has changed there since is removed here."""
    known = mirrored(folder)
    if files == known:
        return
    for name, file in (known or {}).items():
        if files.get(name) != file:
            for copy in (folder / name, folder / HEADERS / name):
                copy.unlink(missing_ok=True)
    write_json(folder / LIST, {"address": address, "files": {name: asdict(file) for name, file in files.items()}})
    if known is None:
        warn(f"{address}: trajectories are kept in {folder} once they are read")


def _list(address: str) -> dict[str, RemoteFile]:
    """The trajectories at an address by their names here."""
    with _address_errors(address):
        system, place = _file_system(address)
        entries = _tried(place, lambda: system.ls(place, detail=True))
        named = {_name(entry["name"], address): entry for entry in entries if entry["type"] == "file"}
        wanted = {name: named[name] for name in sorted(filter(None, named))}
        if not wanted:
            raise DataError(f"{address}: no trajectory in it (*{SUFFIX})")
        with ThreadPoolExecutor(AT_ONCE) as threads:  # a web server's list has names only
            infos = threads.map(functools.partial(_info, system), wanted.values())
            return {name: _remote_file(info, address) for name, info in zip(wanted, infos, strict=True)}


def _info(system: Any, entry: dict[str, Any]) -> dict[str, Any]:
    """What a file system says of a file, with its size."""
    if entry.get("size") is not None:
        return entry
    info: dict[str, Any] = _tried(entry["name"], lambda: system.info(entry["name"]))
    return info


def _name(place: str, address: str) -> str | None:
    """The name of a trajectory's file here, ``None`` for what is none."""
    name = place.rpartition("/")[2]
    name = unquote(name) if address.startswith("http") else name
    plain = name.endswith(SUFFIX) and not name.startswith((ASIDE, ".")) and not set(name) & set("/\\\0")
    return name if plain else None


def _remote_file(info: dict[str, Any], address: str) -> RemoteFile:
    if info.get("size") is None:
        raise DataError(f"{info['name']}: the server does not say its size")
    versions = (info[key] for key in VERSIONS if info.get(key) is not None)
    return RemoteFile(info["name"], int(info["size"]), str(next(versions, "")))


def _bring_headers(address: str, folder: Path, files: dict[str, RemoteFile]) -> None:
    """Fetch the ends of all files of which nothing is here, some at once."""
    missing = [name for name in files if not header(folder / name).is_file()]
    if not missing:
        return
    system, _ = _file_system(address)
    with progress() as bar, ThreadPoolExecutor(AT_ONCE) as threads:
        task = add_task(bar, f"listing {address}", len(missing), "trajectories")
        try:
            for _ in threads.map(lambda name: _bring_header(system, folder / name, files[name]), missing):
                bar.advance(task)
        except BaseException:
            threads.shutdown(cancel_futures=True)
            raise


def _bring_header(system: Any, path: Path, file: RemoteFile) -> None:
    """Write the end of a file as a Parquet file of its own; the whole file where the server sends no parts."""
    with _address_errors(file.place):
        wanted = END
        while True:
            start = max(file.size - wanted, 0)
            end = _tried(file.place, functools.partial(system.cat_file, file.place, start=start, end=file.size))
            needed = int.from_bytes(end[-FOOTER:][:4], "little") + FOOTER
            if needed <= len(end) or needed > file.size or len(end) != file.size - start:
                break
            wanted = needed
    whole = len(end) == file.size
    with written_aside(path if whole else path.parent / HEADERS / path.name) as aside:
        aside.write_bytes(end if whole else MAGIC + end[-needed:])


@functools.lru_cache(maxsize=16)
def _listed(path: Path, changed: int) -> tuple[str, dict[str, RemoteFile]]:
    values = read_json(path)
    try:
        return str(values["address"]), {name: RemoteFile(**file) for name, file in values["files"].items()}
    except (AttributeError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a list of this version; delete {path.parent}, and it is fetched anew") from error


def _file_system(address: str) -> tuple[Any, str]:
    """The file system of an address, and its place there; made anew, for a process that was forked needs its own."""
    from fsspec.core import url_to_fs

    system, place = url_to_fs(address)
    return system, str(place)


def _tried(place: str, work: Callable[[], Result]) -> Result:
    """What a work on the server of a place returns; it is tried anew where a connection to a web server fails."""
    for wait in WAITS if place.startswith("http") else ():
        try:
            return work()
        except (FileNotFoundError, PermissionError, NotImplementedError):
            raise
        except Exception:  # file systems raise errors of their own libraries
            time.sleep(wait)
    return work()


@contextlib.contextmanager
def _address_errors(place: str) -> Iterator[None]:
    """Within the block, whatever a file system raises becomes a ``DataError`` of one line that names the address."""
    try:
        yield
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(f"{place}: nothing is there") from error
    except ImportError as error:
        advice = "pip install 'persist-cli[http]'" if place.startswith("http") else "it is no part of persist"
        raise DataError(f"{place}: {error}; {advice}") from error
    except Exception as error:  # file systems raise errors of their own libraries
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(f"{place}: cannot be read ({cause})") from error
