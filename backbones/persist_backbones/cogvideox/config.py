"""Configurations of diffusers' CogVideoX classes: a tiny model for laptops, and the five published models."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from persist_backbones.cogvideox.diffusion import Prediction, Weighting

VAE_8X = {
    "down_block_types": ("CogVideoXDownBlock3D",) * 4,
    "up_block_types": ("CogVideoXUpBlock3D",) * 4,
    "block_out_channels": (128, 256, 256, 512),
    "layers_per_block": 3,
    "latent_channels": 16,
    "norm_num_groups": 32,
    "temporal_compression_ratio": 4,
}

VAE_TINY = {
    "down_block_types": ("CogVideoXDownBlock3D",) * 3,
    "up_block_types": ("CogVideoXUpBlock3D",) * 3,
    "block_out_channels": (16, 32, 32),
    "layers_per_block": 1,
    "latent_channels": 16,
    "norm_num_groups": 8,
    "temporal_compression_ratio": 4,
    "scaling_factor": 1.0,
}

SCHEDULER = {
    "beta_start": 0.00085,
    "beta_end": 0.0120,
    "beta_schedule": "scaled_linear",
    "clip_sample": False,
    "prediction_type": "v_prediction",
    "rescale_betas_zero_snr": True,
    "set_alpha_to_one": True,
    "timestep_spacing": "trailing",
}

VAE_5B = VAE_8X | {"scaling_factor": 0.7}

VAE_15 = VAE_5B | {"invert_scale_latents": True}

SCHEDULER_5B = SCHEDULER | {"snr_shift_scale": 1.0}

SIZE_2B = {"num_attention_heads": 30, "num_layers": 30}

SIZE_5B = {"num_attention_heads": 48, "num_layers": 42, "use_rotary_positional_embeddings": True}

TEXT_TO_VIDEO = {"in_channels": 16, "out_channels": 16}

IMAGE_TO_VIDEO = {"in_channels": 32, "out_channels": 16}

PATCHES_15 = {"patch_size_t": 2, "patch_bias": False}

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "tiny": {
        "vae": VAE_TINY,
        "transformer": {
            "num_attention_heads": 4,
            "attention_head_dim": 64,
            "num_layers": 6,
            "in_channels": 32,
            "out_channels": 16,
            "time_embed_dim": 256,
            "text_embed_dim": 32,
            "max_text_seq_length": 1,
            "spatial_interpolation_scale": 1.0,
        },
        "scheduler": SCHEDULER_5B,
    },
    "2b": {
        "vae": VAE_8X | {"scaling_factor": 1.15258426},
        "transformer": SIZE_2B | TEXT_TO_VIDEO,
        "scheduler": SCHEDULER | {"snr_shift_scale": 3.0},
    },
    "5b": {"vae": VAE_5B, "transformer": SIZE_5B | TEXT_TO_VIDEO, "scheduler": SCHEDULER_5B},
    "5b-i2v": {
        "vae": VAE_5B,
        "transformer": SIZE_5B | IMAGE_TO_VIDEO | {"use_learned_positional_embeddings": True},
        "scheduler": SCHEDULER_5B,
    },
    "1.5-5b": {"vae": VAE_15, "transformer": SIZE_5B | TEXT_TO_VIDEO | PATCHES_15, "scheduler": SCHEDULER_5B},
    "1.5-5b-i2v": {
        "vae": VAE_15,
        "transformer": SIZE_5B | IMAGE_TO_VIDEO | PATCHES_15 | {"ofs_embed_dim": 512},
        "scheduler": SCHEDULER_5B,
    },
}

LOSS_SETTINGS = (  # settings of losses and of codecs in training, which change nothing of how a model is sampled
    "weighting", "snr_gamma", "channel_weights", "kl_weight", "codec_window", "codec_start", "codec_trains",
)  # fmt: skip


@dataclass(frozen=True)
class CogVideoXSettings:
    """Settings of the video model.

    Args:
        preset: name of the sizes of transformer, VAE and scheduler.
        pretrained: a plain diffusers CogVideoX directory (``transformer/``, ``vae/``, ``scheduler/``) to start from,
            or the name of one on the hub (``zai-org/CogVideoX-5b-I2V``), which is downloaded if it is not here; its
            configuration replaces the preset's. A learned table of positions (5b-I2V) is cut and resampled to the
            clips' size.
        rotary_grid: rows and columns of video tokens for which rotary positions were trained; by default those of the
            weights. A checkpoint remembers them, because a resampled table of positions takes their place in it.
        prompt: the constant prompt of the model, embedded once by the ``text_encoder/`` and ``tokenizer/`` of
            ``pretrained``, which are never downloaded. The empty prompt is embedded too, as CogVideoX was trained with
            it; null gives zeros. A model that starts from no pretrained weights knows no text and has zeros.
        prompt_embedding: in place of ``prompt``, a safetensors file with the embedding as tensor ``prompt``.
        height: height of the images in pixels.
        width: width of the images in pixels.
        frames: frames of a clip, at least two; 2cn + 1 for a VAE that compresses time by c > 1: 9, 17, … for CogVideoX.
        interactions: actions that change the world; each has one embedding for each step of a clip.
        rays: directions of the Plücker rays: ``correct``, or as ``printed`` in the paper, with the translation added.
        depth: false holds depth at zero in the input and leaves it out of the loss: a model of RGB alone with as many
            parameters, whose clips have no depth (0) after the given frame.
        prediction: what the model predicts: ``v_prediction`` for velocities, like CogVideoX, or ``sample`` for clean
            latents; by default that of the preset or of the pretrained weights, which cannot be loaded with any other.
        given: what the image condition holds for the frames to come: nothing (``alone``, as in CogVideoX), or what the
            given frame shows in their views, moved there by its depth and their cameras (``rendered``).
        image_noise: largest level of the noise that training adds to the latents of the given frame, where 1 is as
            strong as the latents themselves; the model is told the level. 0 for neither.
        weighting: weighting of errors: ``uniform``, ``min-snr`` or ``min-snr-plus-one``.
        snr_gamma: γ of the weighting by min-SNR.
        channel_weights: of the errors of a latent pixel's channels: ``equal``, or in ``pixels``, the squared change of
            the decoded image by each, or ``root-pixels``, between the two. Where some channels change the image a
            hundred times as much as others, a loss of equal weights leaves errors in them that are small for latents
            and large to the eye.
        kl_weight: weight of the codec's latent prior in its loss.
        codec_window: frames (a valid number of ``frames``, or 1), height and width of the random windows that the codec
            is trained on; a quarter of the pixels costs a quarter of the time.
        codec_start: weights of a fresh codec: ``random``, or the principal ``components`` of the training images'
            squares of pixels, for a VAE of one block that codes every frame alone.
        codec_trains: what the codec's stage trains: ``all`` of it, or its ``decoder``, so that latents stay as they are
            and models that were trained on them still fit.
        transformer: changes to the preset's transformer configuration.
        vae: changes to the preset's VAE configuration.
    """

    preset: Literal["tiny", "2b", "5b", "5b-i2v", "1.5-5b", "1.5-5b-i2v"] = "tiny"
    pretrained: str | None = None
    rotary_grid: tuple[PositiveInt, PositiveInt] | None = None
    prompt: str | None = ""
    prompt_embedding: str | None = None
    height: PositiveInt = 64
    width: PositiveInt = 64
    frames: int = 9
    interactions: tuple[str, ...] = ("pick_up", "drop", "toggle")
    rays: Literal["correct", "printed"] = "correct"
    depth: bool = True
    prediction: Prediction | None = None
    given: Literal["alone", "rendered"] = "alone"
    image_noise: NonNegativeFloat = 0.0
    weighting: Weighting = "uniform"
    snr_gamma: PositiveFloat = 5.0
    channel_weights: Literal["equal", "root-pixels", "pixels"] = "equal"
    kl_weight: NonNegativeFloat = 1e-6
    codec_window: tuple[int, PositiveInt, PositiveInt] | None = None
    codec_start: Literal["random", "components"] = "random"
    codec_trains: Literal["all", "decoder"] = "all"
    transformer: dict[str, Any] = field(default_factory=dict)
    vae: dict[str, Any] = field(default_factory=dict)
