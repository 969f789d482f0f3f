"""Configurations of the five published CogVideoX models, word for word as in their repositories on the hub.

They are taken from painebenjamin/taproot (one class a model, its configuration a literal), and equal the output of
diffusers' ``scripts/convert_cogvideox_to_diffusers.py`` for the original weights: ``--i2v`` gives 32 input
channels, with version 1.0 learned positions and with 1.5 the ``ofs`` embedding; ``--version 1.5`` gives
``patch_size_t`` 2, ``patch_bias`` false, 300x300 latents of 81 frames and a VAE that inverts the scale of image
latents. The shift of the SNR is 3 for 2b and 1 for all others (zai-org/CogVideo, ``sat/configs``).
"""

from __future__ import annotations

from typing import Any

TRANSFORMER: dict[str, Any] = {
    "activation_fn": "gelu-approximate",
    "attention_bias": True,
    "attention_head_dim": 64,
    "dropout": 0.0,
    "flip_sin_to_cos": True,
    "freq_shift": 0,
    "in_channels": 16,
    "max_text_seq_length": 226,
    "norm_elementwise_affine": True,
    "norm_eps": 1e-05,
    "num_attention_heads": 48,
    "num_layers": 42,
    "out_channels": 16,
    "patch_size": 2,
    "sample_frames": 49,
    "sample_height": 60,
    "sample_width": 90,
    "spatial_interpolation_scale": 1.875,
    "temporal_compression_ratio": 4,
    "temporal_interpolation_scale": 1.0,
    "text_embed_dim": 4096,
    "time_embed_dim": 512,
    "timestep_activation_fn": "silu",
    "use_rotary_positional_embeddings": True,
}

OF_15 = {
    "patch_bias": False,
    "patch_size_t": 2,
    "sample_frames": 81,
    "sample_height": 300,
    "sample_width": 300,
    "use_learned_positional_embeddings": False,
}

TRANSFORMERS: dict[str, dict[str, Any]] = {
    "2b": TRANSFORMER | {"num_attention_heads": 30, "num_layers": 30, "use_rotary_positional_embeddings": False},
    "5b": TRANSFORMER,
    "5b-i2v": TRANSFORMER | {"in_channels": 32, "use_learned_positional_embeddings": True},
    "1.5-5b": TRANSFORMER | OF_15,
    "1.5-5b-i2v": TRANSFORMER | OF_15 | {"in_channels": 32, "ofs_embed_dim": 512},
}

VAE: dict[str, Any] = {
    "act_fn": "silu",
    "block_out_channels": [128, 256, 256, 512],
    "down_block_types": ["CogVideoXDownBlock3D"] * 4,
    "force_upcast": True,
    "in_channels": 3,
    "invert_scale_latents": False,
    "latent_channels": 16,
    "latents_mean": None,
    "latents_std": None,
    "layers_per_block": 3,
    "norm_eps": 1e-06,
    "norm_num_groups": 32,
    "out_channels": 3,
    "sample_height": 480,
    "sample_width": 720,
    "scaling_factor": 0.7,
    "shift_factor": None,
    "temporal_compression_ratio": 4,
    "up_block_types": ["CogVideoXUpBlock3D"] * 4,
    "use_post_quant_conv": False,
    "use_quant_conv": False,
}

VAES: dict[str, dict[str, Any]] = {
    "2b": VAE | {"scaling_factor": 1.15258426},
    "5b": VAE,
    "5b-i2v": VAE,
    "1.5-5b": VAE | {"invert_scale_latents": True},
    "1.5-5b-i2v": VAE | {"invert_scale_latents": True},
}

SCHEDULER: dict[str, Any] = {
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "clip_sample": False,
    "clip_sample_range": 1.0,
    "num_train_timesteps": 1000,
    "prediction_type": "v_prediction",
    "rescale_betas_zero_snr": True,
    "sample_max_value": 1.0,
    "set_alpha_to_one": True,
    "snr_shift_scale": 1.0,
    "steps_offset": 0,
    "timestep_spacing": "trailing",
    "trained_betas": None,
}

SCHEDULERS: dict[str, dict[str, Any]] = {
    "2b": SCHEDULER | {"snr_shift_scale": 3.0},
    "5b": SCHEDULER,
    "5b-i2v": SCHEDULER,
    "1.5-5b": SCHEDULER,
    "1.5-5b-i2v": SCHEDULER,
}
