"""A build backend that gives pip name and version of a source archive from its own PKG-INFO.

pip would run the archive's setup.py for this, before it stores the archive. Here it runs nothing of the archive: the
folder above comes first on the module path of the pip that downloads.
"""

from __future__ import annotations

import email
from pathlib import Path


class __legacy__:
    """The build backend of archives without pyproject.toml."""

    @staticmethod
    def prepare_metadata_for_build_wheel(folder: str, settings: object = None) -> str:
        """Write name and version of the archive in the current folder, and return the name of the metadata folder."""
        fields = email.message_from_string(Path("PKG-INFO").read_text(encoding="utf-8"))
        name, version = fields.get("Name", "0"), fields.get("Version", "0")
        info = Path(folder) / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
        return info.name
