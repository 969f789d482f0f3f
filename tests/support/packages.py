"""Distributions of other authors, installed for a test."""

from __future__ import annotations

import textwrap
from pathlib import Path


def install(folder: Path, package: str, group: str, target: str, code: str = "") -> None:
    """Install a distribution as pip does: a module and its metadata."""
    module = target.partition("=")[2].partition(":")[0].strip()
    if code:
        (folder / f"{module}.py").write_text(textwrap.dedent(code))
    info = folder / f"{package.replace('-', '_')}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{target}\n")
