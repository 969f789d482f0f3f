"""The furnished room as apps of phones store it: Stray Scanner's folders and Record3D's ``.r3d`` files."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import lzfse
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.support.rooms import Room, walk

ROOM = Room()
TIMES = 2  # as many pixels along each side have the colours as the depth
STEP = 0.1  # seconds between two frames


def write_stray(folder: Path, frames: int = 4, turns: int = 0) -> Path:
    """A scan by a phone that was held so that its images are turned by so many times 90° clockwise."""
    for part in ("depth", "confidence"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    pictures, lines = [], ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for number, (frame, pose) in enumerate(zip(ROOM.frames(walk(24)[:frames]), walk(24)[:frames], strict=True)):
        depth = np.rot90(np.round(frame.depth * 1000).astype(np.uint16), -turns)
        sure = np.full(depth.shape, 2, np.uint8)
        sure[0, 0], sure[0, 1] = 0, 1
        Image.fromarray(np.ascontiguousarray(depth)).save(folder / f"depth/{number:06}.png")
        Image.fromarray(sure).save(folder / f"confidence/{number:06}.png")
        pictures.append(np.rot90(frame.rgb, -turns).repeat(TIMES, 0).repeat(TIMES, 1))
        words = [100 + STEP * number, *pose[:3, 3], *(rolled(pose, turns).as_quat())]
        lines.append(", ".join([f"{words[0]:.3f}", f"{number:06}", *(f"{word:.9f}" for word in words[1:])]))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    matrix = TIMES * turned_matrix(turns)
    matrix[2, 2] = 1
    np.savetxt(folder / "camera_matrix.csv", matrix, delimiter=", ")
    write_lossless(folder / "rgb.mp4", pictures)
    return folder


def write_record3d(path: Path, frames: int = 4, each: bool = True, confidence: bool = True) -> Path:
    """A recording with intrinsics for each frame or one matrix, and with confidence or without."""
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = relative_poses(frames)
    height, width = TIMES * ROOM.height, TIMES * ROOM.width
    values: dict[str, object] = {"h": height, "w": width, "dh": ROOM.height, "dw": ROOM.width, "fps": 1 / STEP}
    matrix = TIMES * ROOM.intrinsics
    matrix[2, 2] = 1
    values["K"] = matrix.T.flatten().tolist()
    if each:
        values["perFrameIntrinsicCoeffs"] = [[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]] * frames
        values["frameTimestamps"] = [100 + STEP * number for number in range(frames)]
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    values["poses"] = [[*Rotation.from_matrix((pose @ opengl)[:3, :3]).as_quat(), *pose[:3, 3]] for pose in poses]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(values))
        for number, frame in enumerate(ROOM.frames(walk(24)[:frames])):
            color = io.BytesIO()
            Image.fromarray(frame.rgb.repeat(TIMES, 0).repeat(TIMES, 1)).save(color, "JPEG", quality=100, subsampling=0)
            depth = frame.depth.astype(np.float32).copy()
            depth[0, 0] = np.nan
            archive.writestr(f"rgbd/{number}.jpg", color.getvalue())
            archive.writestr(f"rgbd/{number}.depth", lzfse.compress(depth.tobytes()))
            if confidence:
                sure = np.full(depth.shape, 2, np.uint8)
                sure[0, 1], sure[0, 2] = 0, 1
                archive.writestr(f"rgbd/{number}.conf", lzfse.compress(sure.tobytes()))
    return path


def relative_poses(frames: int) -> np.ndarray:
    """The room's poses relative to the first camera, whose axes are OpenGL's: the world of Record3D."""
    poses = walk(24)[:frames]
    return np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(poses[0]) @ poses


def rolled(pose: np.ndarray, turns: int) -> Rotation:
    """The rotation of a camera whose image is turned by so many times 90° clockwise."""
    return Rotation.from_matrix(pose[:3, :3]) * Rotation.from_euler("z", -90 * turns, degrees=True)


def turned_matrix(turns: int) -> np.ndarray:
    """The matrix of the room's camera when its image is turned by so many times 90° clockwise."""
    (fx, _, cx), (_, fy, cy), _ = ROOM.intrinsics.tolist()
    width, height = ROOM.width, ROOM.height
    for _ in range(turns):
        fx, fy, cx, cy, width, height = fy, fx, height - cy, cx, height, width
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def write_lossless(path: Path, pictures: Sequence[np.ndarray]) -> None:
    """Write pictures as a video that keeps every value."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=Fraction(10), options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "rgb24"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        container.mux(stream.encode())
