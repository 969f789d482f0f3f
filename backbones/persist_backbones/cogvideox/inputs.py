"""The transformer's inputs besides noisy latents: the shape of clips, cameras, interactions and positions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from persist_backbones.cogvideox.codec import spatial_compression
from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.diffusion import Prediction
from persist_backbones.cogvideox.parts import DiffusersParts
from persist_backbones.diffusers_models import (
    CogVideoXDDIMScheduler,
    CogVideoXPatchEmbed,
    CogVideoXTransformer3DModel,
    get_3d_rotary_pos_embed,
)
from persist_backbones.tensors import fold_frames, frames_per_token, tokens_of
from persist_cli.api.backbone import Clips, Interactions
from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import plucker
from persist_cli.errors import CheckpointError, DataError, PersistError


@dataclass(frozen=True)
class ClipShape:
    """The shape of a clip in latent pixels and video tokens.

    Args:
        frames: number of latent frames of a clip, without padding.
        height: height in latent pixels.
        width: width in latent pixels.
        patch: latent pixels along the edge of a video token.
        token_frames: number of latent frames that a video token stands for.
        temporal: number of frames that a latent frame stands for, after the first.
    """

    frames: int
    height: int
    width: int
    patch: int
    token_frames: int
    temporal: int = 1

    def of(self, clips: Clips) -> ClipShape:
        """Return this shape with the latent frames of some clips, which may be shorter; their cameras say how long."""
        longest, frames = (self.frames - 1) * self.temporal + 1, clips.cameras.world_from_camera.shape[1]
        return self if frames == longest else dataclasses.replace(self, frames=(frames - 1) // self.temporal + 1)

    @property
    def padded_frames(self) -> int:
        """Number of latent frames that the model takes, including padding."""
        return self.frames + -self.frames % self.token_frames

    @property
    def tokens(self) -> tuple[int, int, int]:
        """Number of frames, rows and columns of video tokens."""
        return self.padded_frames // self.token_frames, self.height // self.patch, self.width // self.patch

    def pad(
        self, latents: Float[Tensor, "batch frame channel height width"]
    ) -> Float[Tensor, "batch padded_frame channel height width"]:
        """Repeat the first frame in front, up to ``padded_frames``."""
        missing = self.padded_frames - self.frames
        return torch.cat([latents[:, :1].expand(-1, missing, -1, -1, -1), latents], dim=1) if missing else latents

    def drop_padding(
        self, latents: Float[Tensor, "batch padded_frame channel height width"]
    ) -> Float[Tensor, "batch frame channel height width"]:
        """Undo ``pad``."""
        return latents[:, self.padded_frames - self.frames :]

    def image_condition(
        self, known: Float[Tensor, "batch known channel height width"]
    ) -> Float[Tensor, "batch padded_frame channel height width"]:
        """Put latents of the first frame at the first of ``padded_frames`` places, others at the last, zeros else."""
        first, others = known[:, :1], known[:, 1:]
        zeros = first.new_zeros(first.shape[0], self.padded_frames - known.shape[1], *first.shape[2:])
        return torch.cat([first, zeros, others], dim=1)


def check_fit(parts: DiffusersParts, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the parts do not fit each other or the settings' size."""
    check_prediction(parts.scheduler, settings.prediction)
    check_frames(int(parts.vae.config.temporal_compression_ratio), settings)
    config, vae = parts.transformer.config, parts.vae.config
    unit = spatial_compression(parts.vae) * config.patch_size
    if settings.height % unit or settings.width % unit:
        raise CheckpointError(f"image size {settings.height}x{settings.width} must be a multiple of {unit}")
    check_window(settings.codec_window, spatial_compression(parts.vae))
    check_channels(config, vae.latent_channels)
    if settings.given == "rendered" and not settings.depth:
        raise CheckpointError("given=rendered moves the given frame by its depth, of which depth=false leaves none")
    if config.ofs_embed_dim and config.ofs_embed_dim != config.time_embed_dim:
        raise CheckpointError(
            f"a transformer whose ofs_embed_dim {config.ofs_embed_dim} is not its time_embed_dim "
            f"{config.time_embed_dim} cannot add one to the other"
        )
    tables = config.use_learned_positional_embeddings or not config.use_rotary_positional_embeddings
    if config.patch_size_t is not None and tables:
        raise CheckpointError("patch_size_t needs rotary positions alone, as CogVideoX 1.5 has them")


def check_window(window: tuple[int, int, int] | None, spatial: int) -> None:
    """Raise ``CheckpointError`` when a codec of this compression cannot code windows of this size."""
    if window is not None and (window[1] % spatial or window[2] % spatial):
        raise CheckpointError(f"codec_window {list(window)}: height and width must be multiples of {spatial}")


def check_channels(config: Any, latents: int) -> None:
    """Raise ``CheckpointError`` when a transformer's channels or heads cannot be used with so many latent channels."""
    if config.in_channels not in (latents, 2 * latents):
        raise CheckpointError(f"a transformer of {config.in_channels} channels does not fit a VAE of {latents}")
    if config.out_channels != latents:
        raise CheckpointError(
            f"a transformer of {config.out_channels} output channels does not fit a VAE of {latents}; give "
            f"transformer.out_channels={latents}"
        )
    if config.use_rotary_positional_embeddings and config.attention_head_dim % 16:
        raise CheckpointError(f"attention_head_dim {config.attention_head_dim}: rotary positions need a multiple of 16")


def check_prediction(scheduler: CogVideoXDDIMScheduler, wanted: Prediction | None) -> None:
    """Raise ``CheckpointError`` if the scheduler's prediction is not the wanted one, or cannot be trained."""
    kind = scheduler.config.prediction_type
    if kind not in get_args(Prediction):
        raise CheckpointError(f"the scheduler predicts {kind!r}; known: {', '.join(get_args(Prediction))}")
    if wanted not in (None, kind):
        raise CheckpointError(f"prediction is {wanted!r}, but the weights were trained for {kind!r}; leave it out")


def frame_step(temporal: int) -> int:
    """Return n of the lengths 1, 1 + n, 1 + 2n, … of the clips that a codec of this compression in time codes."""
    # diffusers' decoder doubles time in halves, and takes an odd number of latent frames as a sign of a first frame
    return 2 * temporal if temporal > 1 else 1


def check_frames(temporal: int, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when a codec of this compression in time cannot code the settings' frames."""
    step = frame_step(temporal)
    rule, window = f"{step}n + 1, " if step > 1 else "", (settings.codec_window or (1,))[0]
    if settings.frames < 2 or (settings.frames - 1) % step:
        raise CheckpointError(f"frames must be {rule}at least 2, not {settings.frames}")
    if window < 1 or (window - 1) % step:
        raise CheckpointError(f"codec_window's frames must be {rule}at least 1, not {window}")


def check_clip_frames(frames: int, longest: int, temporal: int) -> None:
    """Raise ``PersistError`` for clips that are longer than trained, or that the codec cannot code.

    Args:
        frames: frames of a clip, the given one included.
        longest: frames of a clip in training.
        temporal: the codec's compression in time.
    """
    step = frame_step(temporal)
    if 2 <= frames <= longest and (frames - 1) % step == 0:
        return
    lengths = f"2 to {longest}" if step == 1 else ", ".join(map(str, range(1 + step, longest + 1, step)))
    raise PersistError(f"clips of {frames} frames, the given one included; this model makes clips of {lengths} frames")


def clip_shape(transformer: Any, vae: Any, settings: CogVideoXSettings) -> ClipShape:
    """Return the shape of the settings' clips for diffusers' transformer and VAE."""
    spatial, config = spatial_compression(vae), transformer.config
    return ClipShape(
        frames=(settings.frames - 1) // int(vae.config.temporal_compression_ratio) + 1,
        height=settings.height // spatial,
        width=settings.width // spatial,
        patch=config.patch_size,
        token_frames=frames_per_token(config),
        temporal=int(vae.config.temporal_compression_ratio),
    )


RAY_CHANNELS = 6


def camera_latents(
    cameras: Cameras, spatial: int, temporal: int, printed: bool, multiple: int = 1
) -> Float[Tensor, "batch latent_frame channel height width"]:
    """Return Plücker rays relative to each clip's first camera, at the VAE's compression.

    In space the rays are mean-pooled, which gives the ray through the middle; in time frames are folded into channels
    (unpixelshuffle). Like in the VAE, the first latent frame contains the first frame alone, here repeated to fill its
    channels. For example 9×512×512×6 becomes 3×64×64×24.

    Args:
        cameras: cameras ``[batch, frame]``; the number of frames is 1 plus a multiple of ``temporal``.
        spatial: factor of the compression in height and width.
        temporal: factor of the compression in time.
        printed: whether directions are those printed in the paper.
        multiple: the number of latent frames is padded in front to a multiple of this, like the latents.
    """
    first = invert_rigid(cameras.world_from_camera[:, :1].double())
    local = Cameras(first @ cameras.world_from_camera.double(), cameras.intrinsics, cameras.height, cameras.width)
    rays = plucker(local.resized(local.height // spatial, local.width // spatial), printed)
    return fold_frames(rays.permute(0, 1, 4, 2, 3).float(), temporal, multiple)


def camera_tokens(
    latents: Float[Tensor, "batch frame channel height width"], patch: int, frames: int = 1
) -> Float[Tensor, "batch token folded"]:
    """Return the camera embedding at each video token: the mean over its patch, latent frames folded into channels."""
    means = F.avg_pool2d(latents.flatten(0, 1), patch).unflatten(0, (len(latents), -1, frames))
    return tokens_of(means.flatten(2, 3))


def interaction_rows(clips: Sequence[Interactions], names: Sequence[str], steps: int) -> Int[Tensor, "batch step"]:
    """Return the row of the interaction embedding for each step of each clip, 0 for a step without interaction.

    Raises:
        DataError: for an interaction without an embedding in the model.
    """
    rows = torch.zeros(len(clips), steps, dtype=torch.long)
    for sample, interactions in enumerate(clips):
        for step, name in enumerate(interactions[:steps]):
            if name is None:
                continue
            if name not in names:
                raise DataError(f"the model knows no interaction {name!r}; it has {', '.join(names) or 'none'}")
            rows[sample, step] = 1 + step * len(names) + list(names).index(name)
    return rows


def model_input(noisy: Tensor, image: Tensor, camera: Tensor, depth: bool) -> Tensor:
    """Concatenate the transformer's input channels: noisy RGB, RGB image, noisy depth, depth image and camera.

    Args:
        noisy: noisy latents ``[batch, frame, channel, height, width]`` of RGB and depth.
        image: latents of the image condition, of the same shape.
        camera: camera latents.
        depth: whether the model has depth; false puts zeros in place of both depth parts.
    """
    (color, metres), (color_image, metres_image) = noisy.chunk(2, dim=2), image.chunk(2, dim=2)
    if not depth:
        metres, metres_image = torch.zeros_like(metres), torch.zeros_like(metres_image)
    return torch.cat([color, color_image, metres, metres_image, camera.to(noisy.dtype)], dim=2)


Region = tuple[tuple[int, int], tuple[int, int]]  # row and column of the first place, and one past the last


def rotary_grid(config: Any) -> tuple[int, int]:
    """Return the rows and columns of video tokens of a transformer's sample size, those of its training."""
    return config.sample_height // config.patch_size, config.sample_width // config.patch_size


def rotary_positions(
    config: Any, grid: tuple[int, int, int], trained: tuple[int, int], device: torch.device
) -> tuple[Tensor, Tensor] | None:
    """Return cosines and sines for every video token, ``None`` for models with absolute positions only.

    CogVideoX 1.0 fits a clip's grid into the middle of the training grid; 1.5 counts its rows and columns.

    Args:
        config: configuration of diffusers' transformer.
        grid: number of frames, rows and columns of video tokens.
        trained: rows and columns of video tokens of the training grid, which ``fit_positions`` does not leave in the
            configuration.
        device: device of the result.
    """
    if not config.use_rotary_positional_embeddings:
        return None
    if config.patch_size_t is not None:
        return _cached(_counted_positions, config.attention_head_dim, grid, str(device))
    region = middle_region(grid[1:], trained)
    return _cached(_fitted_positions, config.attention_head_dim, grid, region, str(device))


def _cached(function: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
    """Call a cached function, past its cache while tensors have no values (when memory is estimated)."""
    real = type(torch.empty(0)) is torch.Tensor
    positions: tuple[Tensor, Tensor] = function(*arguments) if real else function.__wrapped__(*arguments)
    return positions


def middle_region(shape: tuple[int, int], trained: tuple[int, int]) -> Region:
    """Return the largest region of the aspect of ``shape`` in the middle of a training grid, both rows × columns."""
    rows, columns = trained
    if shape[0] / shape[1] > rows / columns:
        columns = round(trained[0] / shape[0] * shape[1])
    else:
        rows = round(trained[1] / shape[1] * shape[0])
    top, left = round((trained[0] - rows) / 2), round((trained[1] - columns) / 2)
    return (top, left), (top + rows, left + columns)


@lru_cache(maxsize=16)
def _fitted_positions(channels: int, grid: tuple[int, int, int], region: Region, device: str) -> tuple[Tensor, Tensor]:
    cosines, sines = get_3d_rotary_pos_embed(
        embed_dim=channels,
        crops_coords=region,
        grid_size=grid[1:],
        temporal_size=grid[0],
        device=torch.device(device),
    )
    return cosines, sines


@lru_cache(maxsize=16)
def _counted_positions(channels: int, grid: tuple[int, int, int], device: str) -> tuple[Tensor, Tensor]:
    cosines, sines = get_3d_rotary_pos_embed(
        embed_dim=channels,
        crops_coords=None,
        grid_size=grid[1:],
        temporal_size=grid[0],
        grid_type="slice",
        max_size=grid[1:],  # a larger table would give the same values
        device=torch.device(device),
    )
    return cosines, sines


class ShorterClipsPatchEmbed(CogVideoXPatchEmbed):  # type: ignore[misc]
    """diffusers' patch embedding, which gives shorter clips the first frames of its table of positions.

    diffusers makes a sinusoidal table at every call for clips of another length, and in the place of a learned one too.
    """

    def _get_positional_embeddings(
        self, sample_height: int, sample_width: int, sample_frames: int, device: torch.device | None = None
    ) -> Float[Tensor, "1 word+token channel"]:
        size = (self.sample_height, self.sample_width)
        if (sample_height, sample_width) != size or sample_frames > self.sample_frames:
            made: Tensor = super()._get_positional_embeddings(sample_height, sample_width, sample_frames, device)
            return made
        frames = (sample_frames - 1) // self.temporal_compression_ratio + 1
        tokens = frames * math.prod(side // self.patch_size for side in size)
        table: Tensor = self.pos_embedding
        return table[:, : self.max_text_seq_length + tokens]


def fit_positions(transformer: CogVideoXTransformer3DModel, size: tuple[int, int, int]) -> None:
    """Fit a transformer's table of absolute positions to clips of this size, in place.

    A sinusoidal table is computed once, while diffusers computes it again at every call. A learned table
    (CogVideoX-5b-I2V) is cut to its first frames and to the middle of the images' shape, resampled, and its
    configuration gets the new size; diffusers refuses images of another size and ignores the table for other lengths.

    Args:
        transformer: diffusers' transformer.
        size: number of frames, rows and columns of the latents.

    Raises:
        CheckpointError: for clips that are longer than a learned table.
    """
    table = transformer.patch_embed
    if table.use_positional_embeddings or table.use_learned_positional_embeddings:
        # diffusers has built it by now and filled it with weights; the subclass only replaces a method
        table.__class__ = ShorterClipsPatchEmbed
    sample_size = dict(zip(("sample_frames", "sample_height", "sample_width"), size, strict=True))
    sample_size["sample_frames"] = (size[0] - 1) * table.temporal_compression_ratio + 1
    if all(getattr(table, name) == value for name, value in sample_size.items()):
        return
    if table.use_learned_positional_embeddings:
        table.pos_embedding = _resampled(transformer, size)
        transformer.register_to_config(**sample_size)
    elif table.use_positional_embeddings:
        rows, columns, frames = size[1], size[2], sample_size["sample_frames"]
        device = table.pos_embedding.device
        positions = table._get_positional_embeddings(rows, columns, frames, device=torch.device("cpu"))
        table.pos_embedding = positions.to(device)
    else:
        return
    for name, value in sample_size.items():
        setattr(table, name, value)


def _resampled(
    transformer: CogVideoXTransformer3DModel, size: tuple[int, int, int]
) -> Float[Tensor, "1 word+token channel"]:
    """Return the learned table, cut and resampled for latents of this size."""
    table, patch = transformer.patch_embed, transformer.config.patch_size
    words, frames, rows, columns = table.max_text_seq_length, size[0], size[1] // patch, size[2] // patch
    trained = (table.sample_height // patch, table.sample_width // patch)
    video = table.pos_embedding[0, words:].unflatten(0, (-1, *trained))
    if frames > len(video):
        longest = (len(video) - 1) * table.temporal_compression_ratio + 1
        raise CheckpointError(f"learned positions are for clips of {longest} frames at most; ask for fewer frames")
    (top, left), (bottom, right) = middle_region((rows, columns), trained)
    middle = video[:frames, top:bottom, left:right].permute(0, 3, 1, 2)
    if middle.shape[2:] != (rows, columns):
        middle = F.interpolate(middle.float(), (rows, columns), mode="bilinear").to(video.dtype)
    return torch.cat([table.pos_embedding[:, :words], middle.permute(0, 2, 3, 1).flatten(0, 2)[None]], dim=1)
