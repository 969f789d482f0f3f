"""The training state of a run and its checkpoints, written by one process or in parts by many.

Where the training is sharded each process writes its parts of all tensors into a file of its own, as
``torch.distributed.checkpoint`` does for Hugging Face. Any number of processes can read these files.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch
from accelerate import PartialState
from accelerate.utils import broadcast_object_list
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader, HuggingFaceStorageWriter
from torch.distributed.checkpoint.metadata import TensorStorageMetadata
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from persist_cli.api.checkpoint import STEP, step_folders
from persist_cli.errors import CheckpointError
from persist_cli.io.files import folder_aside, read_json, read_tensors, write_json, write_tensors
from persist_cli.io.sha256sums import check_sums, write_sums
from persist_cli.train.distributed import is_sharded

if TYPE_CHECKING:
    from diffusers.training_utils import EMAModel

STATE_FILE: Final = "training.safetensors"  # of a training that is not sharded

SHARDS_FOLDER: Final = "training"  # with a file of each process

NOTES_FILE: Final = "training.json"  # what of the state is no tensor

RANDOM_CUDA: Final = "random/cuda"  # tensor with the random state of a process's CUDA device


@dataclass
class TrainingState:
    """Everything that changes while a run goes on.

    Args:
        parameters: the trained parameters by name.
        moments: the optimizer's state of each parameter.
        average: the exponential moving average of the parameters, ``None`` when none is kept.
        step: optimizer steps done; the position in the data follows from it.
    """

    parameters: dict[str, nn.Parameter]
    moments: MutableMapping[nn.Parameter, dict[str, Any]]
    average: EMAModel | None
    step: int = 0

    @property
    def sharded(self) -> bool:
        """Whether each process holds only a part of the parameters."""
        return any(map(is_sharded, self.parameters.values()))

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the state, the random state of torch included, by the names that files give them."""
        tensors: dict[str, Tensor] = {"random/torch": torch.get_rng_state()}
        if device := _random_device():  # which draws what is dropped out there
            tensors[RANDOM_CUDA] = torch.cuda.get_rng_state(device)
        for name, parameter in self.parameters.items():
            tensors[f"parameter/{name}"] = parameter
            for key, value in self.moments[parameter].items():
                tensors[f"optimizer/{key}/{name}"] = torch.as_tensor(value)  # a step count may be a plain number
        return tensors | {f"average/{name}": average for name, average in self.averages().items()}

    def averages(self) -> dict[str, Tensor]:
        """The averaged parameters by name, empty when none are kept."""
        return {} if self.average is None else dict(zip(self.parameters, self.average.shadow_params, strict=True))

    @contextlib.contextmanager
    def averaged(self) -> Iterator[None]:
        """Within the block the parameters have their averaged values, where these are kept."""
        if self.average is None:
            yield
            return
        parameters = [*self.parameters.values()]
        self.average.store(parameters)
        self.average.copy_to(parameters)
        try:
            yield
        finally:
            self.average.restore(parameters)

    def write(self, folder: Path, main: bool) -> dict[str, Any]:
        """Write the tensors into a checkpoint's folder; all processes must call it.

        Args:
            folder: an existing folder.
            main: whether this is the main process, which alone writes what is not sharded.

        Returns:
            The JSON values that ``read`` expects in the folder's ``training.json``.
        """
        notes = {"step": self.step, "ema_steps": self.average.optimization_step if self.average else 0}
        tensors = self.tensors()  # with DeepSpeed, processes gather them together
        if self.sharded:
            write_shards(folder / SHARDS_FOLDER, tensors)
            return notes | {"files": len(list((folder / SHARDS_FOLDER).iterdir()))}
        if main:
            write_tensors(folder / STATE_FILE, tensors)
        return notes

    def read(self, folder: Path) -> None:
        """Restore the state that was written into a checkpoint's folder, by any number of processes.

        Raises:
            CheckpointError: when a file is missing or damaged, or a tensor is missing or of another shape.
        """
        check_sums(folder, _has_no_checksum)
        notes: dict[str, Any] = read_json(folder / NOTES_FILE)
        shards = folder / SHARDS_FOLDER if "files" in notes else folder
        if "files" in notes and len(list(shards.glob("*.safetensors"))) != notes["files"]:
            raise CheckpointError(f"{shards}: of its {notes['files']} files some are missing; go back to a whole copy")
        if "files" in notes or self.sharded:
            self._restore(read_shards(shards, self._empty_like), shards)
        else:
            self._restore(read_tensors(folder / STATE_FILE)[0], folder / STATE_FILE)
        self.step = int(notes["step"])
        if self.average is not None:
            self.average.optimization_step = int(notes["ema_steps"])

    def _empty_like(self, name: str, shape: torch.Size, dtype: torch.dtype) -> Tensor:
        """A tensor to read one of the state into, sharded like the parameter that it belongs to."""
        parameter = self.parameters.get(name.split("/")[-1])
        if parameter is None or parameter.shape != shape:
            return torch.empty(shape, dtype=dtype)
        return torch.empty_like(parameter, dtype=dtype, requires_grad=False)

    def _restore(self, tensors: dict[str, Tensor], path: Path) -> None:
        averages, moments = self.averages(), _moments_by_parameter(tensors)
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(_take(tensors, f"parameter/{name}", parameter, path))
                if name in averages:
                    averages[name].copy_(_take(tensors, f"average/{name}", parameter, path))
                self.moments[parameter] = {
                    key: _step_count(value) if key == "step" else value.to(parameter.device)
                    for key, value in moments.get(name, {}).items()
                }
        torch.set_rng_state(tensors["random/torch"])
        device = _random_device()
        if device and RANDOM_CUDA in tensors:  # checkpoints of a CPU lack it, and those of earlier versions
            torch.cuda.set_rng_state(tensors[RANDOM_CUDA], device)


def save_state(run: Path, state: TrainingState, save_model: Callable[[Path, Path], None]) -> None:
    """Write a checkpoint aside and rename it to ``step-…``; all processes must call it.

    Args:
        run: the run's folder.
        state: the state of the training.
        save_model: called with a folder to make, and the place where that folder will be in the end; its main process
            writes the model there that other commands load.
    """
    main = PartialState().is_main_process
    checkpoint = run / f"{STEP}{state.step:08d}"
    with _shared_folder_aside(checkpoint) as aside:
        notes = state.write(aside, main)
        save_model(aside / "model", checkpoint / "model")
        if main:
            write_json(aside / NOTES_FILE, notes)
            write_sums(aside, wanted=_has_no_checksum)


def load_state(run: Path, state: TrainingState) -> None:
    """Restore the newest checkpoint of a run, if there is one."""
    folders = step_folders(run)
    if folders:
        state.read(folders[-1])


def _has_no_checksum(name: str) -> bool:
    """Whether a file in a checkpoint's folder has no checksum of its own; the folder of the model has its own list."""
    return name == NOTES_FILE or name.startswith(f"{SHARDS_FOLDER}/")


def write_shards(folder: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write this process's parts into a folder; all processes must call it with the same names.

    Raises:
        OSError: on every process, naming those that could not write.
    """
    try:
        save(dict(tensors), storage_writer=HuggingFaceStorageWriter(str(folder), save_distributed=True))
    except CheckpointException as error:
        raise OSError(_causes(error)) from error


def read_shards(folder: Path, empty: Callable[[str, torch.Size, torch.dtype], Tensor]) -> dict[str, Tensor]:
    """Read the parts that this process needs of every tensor.

    Args:
        folder: a folder with the files of ``write_shards``, or with a single file of whole tensors.
        empty: makes a tensor to read into, of a name, shape and type; a sharded one takes its part.

    Raises:
        CheckpointError: one line when a file is not whole.
    """
    try:
        reader = HuggingFaceStorageReader(str(folder))
        tensors = {
            name: empty(name, metadata.size, metadata.properties.dtype)
            for name, metadata in reader.read_metadata().state_dict_metadata.items()
            if isinstance(metadata, TensorStorageMetadata)
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no_dist is meant: each process reads without the others
            load(tensors, storage_reader=HuggingFaceStorageReader(str(folder)), no_dist=True)
    except CheckpointException as error:
        raise CheckpointError(f"{folder}: its parts cannot be read ({_causes(error)})") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{folder}: its parts cannot be read ({str(error).splitlines()[0]})") from error
    return tensors


def _random_device() -> torch.device | None:
    """The CUDA device of this process, which has a random state of its own; ``None`` on a CPU."""
    device: torch.device = PartialState().device
    return device if device.type == "cuda" else None


def _causes(error: CheckpointException) -> str:
    """One line that says what went wrong on which process."""
    causes = {process: str(cause).splitlines() for process, (cause, _) in error.failures.items()}
    return "; ".join(f"process {process}: {lines[0] if lines else '?'}" for process, lines in sorted(causes.items()))


@contextlib.contextmanager
def _shared_folder_aside(path: Path) -> Iterator[Path]:
    """The main process's ``folder_aside``, which all processes may write into."""
    main = PartialState().is_main_process
    with folder_aside(path) if main else contextlib.nullcontext(path) as aside:
        name = [str(aside)]
        broadcast_object_list(name)
        yield Path(name[0])


def _moments_by_parameter(tensors: dict[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    moments: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer/"):
            _, key, parameter = name.split("/")
            moments.setdefault(parameter, {})[key] = tensor
    return moments


def _step_count(steps: Tensor) -> Tensor | int:
    """The count as the optimizer keeps it that it was saved from: a float tensor of torch's, else a plain number."""
    return steps.clone() if steps.is_floating_point() else int(steps)


def _take(tensors: dict[str, Tensor], name: str, like: Tensor, path: Path) -> Tensor:
    if name not in tensors or tensors[name].shape != like.shape:
        raise CheckpointError(f"{path}: {name} is missing or of another shape; the recipe is not the run's own")
    return tensors[name]
