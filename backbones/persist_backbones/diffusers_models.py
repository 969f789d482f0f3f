"""diffusers' classes that the model is built from, imported without the rest of diffusers.

``from diffusers import CogVideoXTransformer3DModel`` takes three to four times as long as importing torch, because it
executes all models of diffusers, their hooks, transformers, torch's compiler and PEFT. These are imported later, when
something of them is used (``python tests/benchmarks/bench_imports.py``).
"""

from __future__ import annotations

from persist_backbones.deferred_imports import deferred_imports

WAITING = (
    "diffusers.hooks",
    "diffusers.hooks.group_offloading",
    "diffusers.models.autoencoders",
    "diffusers.models.transformers",
    "diffusers.models.unets",
    "diffusers.quantizers",
    "peft",
    "peft.helpers",
    "peft.tuners",
    "peft.tuners.tuners_utils",
    "scipy.integrate",
    "scipy.stats",
    "transformers",
)
LEFT_OUT = ("torch._dynamo",)  # diffusers marks its blocks for torch.compile where it can, which changes no result

with deferred_imports(WAITING, LEFT_OUT):
    from diffusers.loaders.lora_base import LORA_ADAPTER_METADATA_KEY, LORA_WEIGHT_NAME_SAFE
    from diffusers.models.autoencoders.autoencoder_kl_cogvideox import (
        AutoencoderKLCogVideoX,
        CogVideoXCausalConv3d,
        CogVideoXResnetBlock3D,
        CogVideoXSafeConv3d,
    )
    from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
    from diffusers.models.embeddings import CogVideoXPatchEmbed, get_3d_rotary_pos_embed
    from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXTransformer3DModel
    from diffusers.schedulers.scheduling_ddim_cogvideox import CogVideoXDDIMScheduler
    from diffusers.schedulers.scheduling_dpm_cogvideox import CogVideoXDPMScheduler
    from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
    from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler

__all__ = [
    "LORA_ADAPTER_METADATA_KEY",
    "LORA_WEIGHT_NAME_SAFE",
    "AutoencoderKLCogVideoX",
    "CogVideoXCausalConv3d",
    "CogVideoXDDIMScheduler",
    "CogVideoXDPMScheduler",
    "CogVideoXPatchEmbed",
    "CogVideoXResnetBlock3D",
    "CogVideoXSafeConv3d",
    "CogVideoXTransformer3DModel",
    "DPMSolverMultistepScheduler",
    "DiagonalGaussianDistribution",
    "UniPCMultistepScheduler",
    "get_3d_rotary_pos_embed",
]
