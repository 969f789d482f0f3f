"""NoMaD's published weights under the names of our network, and the card that makes them a trained policy.

The file is the dictionary of tensors that its authors' training saves (``nomad.pth``). This was written from their code
and has not been run on the file itself.
"""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from persist_cli.api.meta_device import without_weights
from persist_cli.errors import CheckpointError
from persist_cli.policies.nomad.network import NomadNetwork, NomadNetworkSettings
from persist_cli.policies.trained import write_policy_card

UNUSED: Final = re.compile(  # a layer that is only copied, the classifier's head, and positions that are computed
    r"vision_encoder\.(sa_layer\.|(obs|goal)_encoder\._fc\.|positional_encoding\.)"
)

RULES: Final = tuple(
    (re.compile(published), ours)
    for published, ours in (
        (r"^module\.", ""),  # of a training on several GPUs
        (r"^vision_encoder\.obs_encoder\.", "seen_encoder."),
        (r"^vision_encoder\.goal_encoder\.", "goal_encoder."),
        (r"^vision_encoder\.compress_obs_enc\.", "seen_token."),
        (r"^vision_encoder\.compress_goal_enc\.", "goal_token."),
        (r"^vision_encoder\.sa_encoder\.", "transformer."),
        (r"^dist_pred_net\.network\.", "distance."),
        (r"(_blocks\.\d+)\._bn0\.", r"\1.expand_norm."),
        (r"(_blocks\.\d+)\._bn1\.", r"\1.depthwise_norm."),
        (r"(_blocks\.\d+)\._bn2\.", r"\1.project_norm."),
        (r"\._blocks\.", ".blocks."),
        (r"\._expand_conv\.", ".expand."),
        (r"\._depthwise_conv\.", ".depthwise."),
        (r"\._se_reduce\.", ".squeeze."),
        (r"\._se_expand\.", ".excite."),
        (r"\._project_conv\.", ".project."),
        (r"\._conv_stem\.", ".stem."),
        (r"\._bn0\.", ".stem_norm."),
        (r"\._conv_head\.", ".head."),
        (r"\._bn1\.", ".head_norm."),
        (r"^noise_pred_net\.diffusion_step_encoder\.1\.", "noise.embed_first."),
        (r"^noise_pred_net\.diffusion_step_encoder\.3\.", "noise.embed_second."),
        (r"^noise_pred_net\.(down|up)_modules\.(\d+)\.0\.", r"noise.\1.\2.first."),
        (r"^noise_pred_net\.(down|up)_modules\.(\d+)\.1\.", r"noise.\1.\2.second."),
        (r"^noise_pred_net\.(down|up)_modules\.(\d+)\.2\.conv\.", r"noise.\1.\2.resize."),
        (r"^noise_pred_net\.mid_modules\.", "noise.middle."),
        (r"^noise_pred_net\.final_conv\.0\.block\.", "noise.last."),
        (r"^noise_pred_net\.final_conv\.1\.", "noise.out."),
        (r"\.blocks\.0\.block\.", ".first."),
        (r"\.blocks\.1\.block\.", ".second."),
        (r"\.cond_encoder\.", ".condition."),
        (r"\.residual_conv\.", ".shortcut."),
    )
)


def our_names(tensors: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Tensors of the published network under the names of ours.

    Raises:
        CheckpointError: when a tensor is missing, unknown or of another shape.
    """
    renamed = {_our_name(name): value for name, value in tensors.items() if not UNUSED.search(name)}
    with without_weights():
        expected = {name: value.shape for name, value in NomadNetwork(NomadNetworkSettings()).state_dict().items()}
    wrong = sorted(name for name in expected if name not in renamed or renamed[name].shape != expected[name])
    unknown = sorted(set(renamed) - set(expected))
    if wrong or unknown:
        raise CheckpointError(
            f"{path}: not NoMaD's weights; {len(wrong)} tensors are missing or of another shape and {len(unknown)} "
            f"unknown, first {(wrong + unknown)[0]!r}"
        )
    return {name: value.float().clone(memory_format=torch.contiguous_format) for name, value in renamed.items()}


def write_nomad_card(folder: Path) -> None:
    """Write ``policy.json`` beside the weights, with the published sizes."""
    write_policy_card(folder, "nomad", asdict(NomadNetworkSettings()), None)


def _our_name(name: str) -> str:
    for published, ours in RULES:
        name = published.sub(ours, name)
    return name
