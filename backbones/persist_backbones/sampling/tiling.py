"""Tiles of the codec, at the size that the model works at."""

from __future__ import annotations

from diffusers import AutoencoderKLCogVideoX

from persist_cli.world.errors import CheckpointError

OVERLAP = 1 / 6  # of a tile, diffusers' own


def enable_tiling(vae: AutoencoderKLCogVideoX, height: int, width: int) -> None:
    """Code in tiles of half the image's height and width, which overlap by a whole number of latent pixels.

    With an overlap that is not, diffusers' tiles do not make up the image.

    Args:
        vae: diffusers' autoencoder.
        height: of what it is given.
        width: likewise.

    Raises:
        CheckpointError: when the image is too small to be tiled.
    """
    scale = 2 ** (len(vae.config.block_out_channels) - 1)
    tiles = [-(-side // (2 * scale)) for side in (height, width)]
    shares = [overlap(tile, scale) for tile in tiles]
    vae.enable_tiling(tiles[0] * scale, tiles[1] * scale, *shares)


def overlap(tile: int, scale: int) -> float:
    """The share of a tile of latent pixels that diffusers' arithmetic makes whole pixels, nearest to its own.

    Args:
        tile: latent pixels along an edge.
        scale: pixels of a latent pixel.
    """
    for pixels in sorted(range(1, tile), key=lambda count: abs(count - OVERLAP * tile)):
        share = pixels / tile
        if int(tile * share) == pixels and int(tile * scale * (1 - share)) == scale * (tile - pixels):
            return share
    raise CheckpointError(f"vae-tiling: tiles of {tile} latent pixels are too small to overlap; leave it out")
