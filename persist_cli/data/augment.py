"""Random views of a clip for training: a window of its images, its room mirrored, and other light and colours.

A view changes the frames of a clip and of its memory alike, with their cameras, so that geometry stays exact.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.data.images import CropResize, crop_resize

BRIGHTNESS_AND_CHANNELS = 4  # random factors of the colours


@dataclass(frozen=True)
class Augmentation:
    """How far views differ from the recorded images.

    Args:
        crop: smallest height of a random window, relative to the largest window of the model's aspect; 1 takes images
            as they are.
        mirror: share of the clips whose room is mirrored.
        color_jitter: largest relative change of the brightness, and as much of each colour channel.
    """

    crop: float = 1.0
    mirror: float = 0.0
    color_jitter: float = 0.0

    def draw(self, info: TrajectoryInfo, image_size: tuple[int, int], random: np.random.Generator) -> View | None:
        """A random view of images of this trajectory; ``None``, without drawing, where nothing changes.

        Args:
            info: gives the size of the images.
            image_size: height and width in pixels that the view has.
            random: draws it.
        """
        if self == Augmentation():
            return None
        window = None
        if self.crop < 1:
            window = random_window((info.height, info.width), image_size, float(random.uniform(self.crop, 1)), random)
        mirrored = bool(random.random() < self.mirror)
        brightness, *channels = random.uniform(1 - self.color_jitter, 1 + self.color_jitter, BRIGHTNESS_AND_CHANNELS)
        red, green, blue = (round(float(brightness * channel), 4) for channel in channels)
        return View(window, mirrored, (red, green, blue))


@dataclass(frozen=True)
class View:
    """One view, the same for all frames of a sample.

    Args:
        window: the window of the images, ``None`` for the whole image.
        mirrored: whether the room is mirrored in an upright plane through the world's origin.
        gains: factor of red, green and blue; what becomes too bright is white.
    """

    window: CropResize | None
    mirrored: bool
    gains: tuple[float, float, float]

    def to_json(self) -> dict[str, Any]:
        """The view as JSON values, which a cache's keys hold."""
        return asdict(self)

    def observations(self, frames: Observations, world_up: tuple[float, float, float]) -> Observations:
        """The frames as this view shows them.

        Args:
            frames: RGB and depth may be of no frames, when only cameras were read.
            world_up: unit vector that points up in the world, which mirroring leaves as it is.
        """
        rgb, depth, cameras = frames.rgb, frames.depth, frames.cameras
        if self.window is not None:
            rgb, depth, cameras = self._windows(rgb), self._depth_windows(depth), self._cropped(cameras)
        if self.gains != (1.0, 1.0, 1.0):
            rgb = (rgb * torch.tensor(self.gains)).round().clamp(0, 255).to(torch.uint8)
        if self.mirrored:
            rgb, depth, cameras = rgb.flip(2), depth.flip(2), mirrored_cameras(cameras, world_up)
        return replace(frames, rgb=rgb.contiguous(), depth=depth.contiguous(), cameras=cameras)

    def _windows(self, rgb: Tensor) -> Tensor:
        assert self.window is not None
        images = [torch.from_numpy(self.window.rgb(image)) for image in rgb.numpy()]
        return torch.stack(images) if images else rgb.new_zeros(0, *self.window.size, 3)

    def _depth_windows(self, depth: Tensor) -> Tensor:
        assert self.window is not None
        images = [torch.from_numpy(self.window.depth(image)) for image in depth.numpy()]
        return torch.stack(images) if images else depth.new_zeros(0, *self.window.size)

    def _cropped(self, cameras: Cameras) -> Cameras:
        assert self.window is not None
        return cameras.cropped(self.window.top, self.window.left, *self.window.window).resized(*self.window.size)


def random_window(
    source: tuple[int, int], size: tuple[int, int], share: float, random: np.random.Generator
) -> CropResize:
    """A window at a random place, whose sides are ``share`` of those of the largest one of the target's aspect.

    Args:
        source: height and width of the images in pixels.
        size: height and width of the view in pixels.
        share: above 0 to 1.
        random: draws the place.
    """
    largest = crop_resize(source, size)
    height, width = (max(1, round(side * share)) for side in largest.window)
    top, left = (int(random.integers(whole - part + 1)) for whole, part in zip(source, (height, width), strict=True))
    return CropResize(top, left, (height, width), size)


def mirrored_cameras(cameras: Cameras, world_up: tuple[float, float, float]) -> Cameras:
    """The cameras that see the mirrored world in images whose columns are turned round.

    With S the reflection of the world in an upright plane and C that of a camera's x, the pose T becomes S T C: a
    rigid transform again, since it mirrors twice.
    """
    up = torch.tensor(world_up, dtype=torch.float64)
    level = torch.linalg.cross(up, torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())])
    normal = level / level.norm()
    world, camera = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    world[:3, :3] -= 2 * normal[:, None] * normal
    camera[0, 0] = -1.0
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 0, 2] = cameras.width - intrinsics[..., 0, 2]
    intrinsics[..., 0, 1] *= -1
    poses = cameras.world_from_camera
    return replace(cameras, world_from_camera=(world @ poses.double() @ camera).to(poses), intrinsics=intrinsics)
