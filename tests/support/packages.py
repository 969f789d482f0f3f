"""Distributions of other authors, installed for a test."""

from __future__ import annotations

import textwrap
from pathlib import Path

LAST_FRAME = """
    import torch
    from persist_cli.api.memory import Memory
    from persist_cli.api.tokens import MemoryTokens

    class LastFrame(Memory):
        frame = torch.zeros(0)
        def write(self, observations): self.frame = self.encoder.encode(observations.rgb[-1:])[0].flatten(0, 1)
        def read(self, cameras, budget):
            features = self.frame[:budget].reshape(-1, self.encoder.channels)
            return MemoryTokens.of(features, cameras.centers[:1].expand(len(features), 3))
        def tensors(self): return {"frame": self.frame}
        def restore(self, tensors): self.frame = tensors.get("frame", torch.zeros(0))
"""


def install(folder: Path, package: str, group: str, target: str, code: str = "") -> None:
    """Install a distribution as pip does: a module and its metadata."""
    module = target.partition("=")[2].partition(":")[0].strip()
    if code:
        (folder / f"{module}.py").write_text(textwrap.dedent(code))
    info = folder / f"{package.replace('-', '_')}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{target}\n")
