"""Files and folders that are whole or absent: they are written aside, synced and renamed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.checksums import CHECKSUM, is_verified, is_whole, tensor_bytes, tensor_checksum, with_row_checksums

if TYPE_CHECKING:
    from torch import Tensor, nn

ASIDE: Final = ".partial-"  # the beginning of the names of files and folders that are being written
DAMAGED: Final = "damaged, its checksum is wrong; take a whole copy, or make it anew"
ENVIRONMENT: Final = "PERSIST_REFERENCE"  # a folder that holds the bundled model and data instead of the package


SCHEME: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")  # how an address begins; drives of Windows have one letter


def check_folder(path: Path) -> None:
    """Raise ``PersistError`` when this folder cannot be made or written into, before any work is done."""
    if len(path.parts) > 1 and SCHEME.fullmatch(path.parts[0]) and not Path(path.parts[0]).exists():
        raise PersistError(f"{path}: an address; only folders of this machine are written into, choose another --out")
    nearest = next((folder for folder in (path, *path.parents) if folder.exists()), path)
    if nearest.exists() and not nearest.is_dir():
        raise PersistError(f"{path}: no folder can be made there, {nearest} is a file; choose another --out")
    if nearest.exists() and not os.access(nearest, os.W_OK | os.X_OK):
        raise PersistError(f"{path}: cannot be written, {nearest} is read-only for this user; choose another --out")


def check_file(path: Path) -> None:
    """Raise ``PersistError`` when this file cannot be written, before any work is done."""
    check_folder(path.parent)
    if path.is_dir():
        raise PersistError(f"{path}: a folder; name a file to write")


SAFETENSORS_TYPES: Final = {  # the format's names for those of torch
    "float64": "F64", "float32": "F32", "float16": "F16", "bfloat16": "BF16", "float8_e4m3fn": "F8_E4M3",
    "float8_e5m2": "F8_E5M2", "int64": "I64", "int32": "I32", "int16": "I16", "int8": "I8", "uint64": "U64",
    "uint32": "U32", "uint16": "U16", "uint8": "U8", "bool": "BOOL", "complex64": "C64",
}  # fmt: skip


@contextlib.contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Within the block a folder is there; what had to be made is removed again when the block leaves nothing in it."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder that becomes ``path`` when the block ends well.

    When it does not, folders that were made for it are removed again, unless something else is in them by then.
    """
    aside = _path_aside(path)
    with made_folder(path.parent):
        try:
            yield aside
            with aside.open("r+b") as file:  # Windows syncs no file that is open for reading alone
                os.fsync(file.fileno())
            aside.replace(path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Write text, whole or not at all; the same bytes on every system, as lists of hashes expect."""
    with written_aside(path) as aside:
        aside.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write JSON, whole or not at all; NaN and infinity become null."""
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """The text of a JSON file; NaN and infinity become null."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """The value in the types of JSON; NaN and infinity, which JSON does not have, become ``None``."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write a safetensors file with a checksum, whole or not at all; equal tensors make equal bytes.

    The file is written here and not by the safetensors package, which orders metadata at random, lets nobody but the
    user read the file, and leaves a temporary file when it is killed.

    Raises:
        OSError: when it cannot be written, as on a full disk.
        ValueError: for a tensor of a type that safetensors does not have.
    """
    plain_tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = dict(metadata or {})
    header[CHECKSUM] = tensor_checksum(plain_tensors, header)
    order = sorted(plain_tensors, key=lambda name: (-plain_tensors[name].element_size(), name))
    with written_aside(path) as aside:
        try:
            with aside.open("wb") as file:
                file.write(_safetensors_header(plain_tensors, order, header))
                for name in order:
                    file.write(tensor_bytes(plain_tensors[name]))
        except OSError as error:  # it does not name the file
            raise OSError(error.errno, error.strerror, str(path)) from error


def _safetensors_header(tensors: Mapping[str, Tensor], order: Sequence[str], metadata: Mapping[str, str]) -> bytes:
    """The beginning of a safetensors file: the length of a JSON text, and that with the place of each tensor."""
    values: dict[str, Any] = {"__metadata__": dict(sorted(metadata.items()))}
    end = 0
    for name in order:
        tensor = tensors[name]
        kind = str(tensor.dtype).removeprefix("torch.")
        if kind not in SAFETENSORS_TYPES:
            raise ValueError(f"{name}: safetensors has no type {kind}")
        begin, end = end, end + tensor.nbytes
        values[name] = {"dtype": SAFETENSORS_TYPES[kind], "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(values, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of eight bytes
    return len(text).to_bytes(8, "little") + text


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and metadata of a safetensors file, the tensors in memory that torch allocated.

    The tensors of safetensors are aligned in memory as they are in the file. Where torch would have aligned them in
    another way, some processors' kernels round differently, and a model that is read would not compute to the bit what
    the written one did.

    Raises:
        CheckpointError: one line when the file is missing, truncated, not safetensors, or differs from its checksum.
    """
    tensors, metadata = _copied(path, lambda tensor: tensor.clone())
    if is_verified(path) and not is_whole(tensors, metadata):
        raise CheckpointError(f"{path}: {DAMAGED}")
    metadata.pop(CHECKSUM, None)
    return tensors, metadata


def read_rows(path: Path, rows: Sequence[int]) -> dict[str, Tensor]:
    """Rows of the tensors of a file that ``with_row_checksums`` gave; no more of it is read, however large it is.

    Raises:
        CheckpointError: as from ``read_tensors``, where one of these rows differs from its checksum.
    """
    tensors, _ = _copied(path, lambda tensor: tensor[list(rows)])
    checksums = tensors.pop(CHECKSUM)
    if not checksums.equal(with_row_checksums(tensors)[CHECKSUM]):
        raise CheckpointError(f"{path}: {DAMAGED}")
    return tensors


def _copied(path: Path, copy: Callable[[Tensor], Tensor]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Copies of the tensors of a safetensors file, which is mapped and read no further than they need, and metadata."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise CheckpointError(f"{path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: copy(file.get_tensor(name)) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (SafetensorError, ValueError, OSError) as error:
        raise CheckpointError(f"{path}: not a whole safetensors file ({str(error).splitlines()[0]})") from error


def load_exactly(module: nn.Module, tensors: dict[str, Tensor], names: set[str], path: Path) -> None:
    """Load tensors into a module, which keeps its precision whatever theirs is.

    Args:
        module: the module, which may be on the meta device.
        tensors: the tensors of a file by name.
        names: the names of the module's tensors that the file must hold, no more and no less.
        path: the file, which error messages name.

    Raises:
        CheckpointError: when names or shapes differ.
    """
    import torch

    state = module.state_dict()
    different = sorted(names ^ set(tensors))
    different += sorted(name for name in names & set(tensors) if state[name].shape != tensors[name].shape)
    if different:
        raise CheckpointError(
            f"{path}: does not fit this model; {len(different)} tensors differ, first {different[0]!r}"
        )
    cast = {name: value.to(state[name].dtype) for name, value in tensors.items()}
    with torch.no_grad():
        module.load_state_dict(cast, strict=False, assign=any(state[name].is_meta for name in names))


def reallocate(module: nn.Module) -> None:
    """Move the weights of a module that another library read into memory that torch allocated; see ``read_tensors``."""
    for tensor in (*module.parameters(), *module.buffers()):
        tensor.data = tensor.data.clone()


def read_json(path: Path, refusal: type[PersistError] = CheckpointError, missing: str = "no such file") -> Any:
    """The value of a JSON file.

    Args:
        path: the file.
        refusal: the error that is raised.
        missing: what it says of a file that is not there.

    Raises:
        PersistError: of the kind ``refusal``, one line when the file is missing or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise refusal(f"{path}: {missing}") from error
    except (ValueError, OSError, RecursionError) as error:
        raise refusal(f"{path}: not readable as JSON ({str(error).splitlines()[0]})") from error


def file_sha256(path: Path) -> str:
    """SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_sha256(home: Path, paths: Iterable[Path]) -> str:
    """SHA-256 over the names below ``home`` and the contents of some files."""
    digest = hashlib.sha256()
    for name, path in sorted((path.relative_to(home).as_posix(), path) for path in paths):
        digest.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@contextlib.contextmanager
def empty_folder_aside(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path``, which is removed with all that is still in it when the block ends."""
    aside = _path_aside(path)
    aside.mkdir(parents=True)
    try:
        yield aside
    finally:
        shutil.rmtree(aside, ignore_errors=True)


@contextlib.contextmanager
def folder_aside(path: Path, age: float = 0.0) -> Iterator[Path]:
    """A temporary folder that becomes ``path`` when the block ends well and replaces what is there.

    Whatever a killed writer of ``path`` left aside is removed first.

    Args:
        path: the folder.
        age: seconds for which what is removed must have lain there, where others may write ``path`` meanwhile.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent, path.name, age=age)
    with empty_folder_aside(path) as aside:
        yield aside
        if path.exists():  # a folder cannot be renamed over one that is not empty, so the old one is moved aside first
            with empty_folder_aside(path) as old:
                try:
                    path.rename(old / path.name)
                    aside.rename(path)
                except BaseException:
                    if not path.exists():
                        (old / path.name).rename(path)
                    raise
        else:
            aside.rename(path)


def remove_leftovers(folder: Path, *names: str, age: float = 0.0) -> None:
    """Delete what killed writers left aside in ``folder``, as far as this user may.

    Args:
        folder: where they wrote.
        names: of the files and folders that they wrote; all where none is named.
        age: seconds for which it must have lain there, so that what others write meanwhile stays.
    """
    for leftover in folder.glob(f"{ASIDE}*"):
        owner = leftover.name.removeprefix(ASIDE).partition("-")[2]
        if (names and owner not in names) or _seconds_since_change(leftover) < age:
            continue
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):  # another user's, in a folder that several share
                leftover.unlink(missing_ok=True)


def follow_umask(folder: Path) -> None:
    """Give the files below a folder the mode that new files get; the safetensors package lets only the user read."""
    mask = os.umask(0o077)
    os.umask(mask)
    for path in folder.rglob("*"):
        if path.is_file():
            path.chmod(0o666 & ~mask)


def _seconds_since_change(path: Path) -> float:
    """How long ago a file was written to, or something was added to a folder; 0 when it has gone meanwhile."""
    try:
        return max(0.0, time.time() - path.stat().st_mtime)
    except FileNotFoundError:
        return 0.0


def _path_aside(path: Path) -> Path:
    return path.parent / f"{ASIDE}{uuid.uuid4().hex[:8]}-{path.name}"


def relative_place(path: Path, folder: Path) -> str:
    """A resolved path as seen from a resolved folder, with slashes; absolute on another drive of Windows."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return path.as_posix()


def bundled_folder(name: str) -> Path:
    """The folder of this name beside the recipes, or where the environment variable says; it need not exist."""
    return Path(os.environ.get(ENVIRONMENT) or str(resources.files("persist_recipes"))) / name
