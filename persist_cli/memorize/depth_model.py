"""Metric depth of a picture by a model of transformers, from a folder or the hub."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.errors import DataError
from persist_cli.output.console import busy

ADVICE = "take one of metres, such as depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
METRIC = ("zoedepth", "depth_pro")  # kinds whose models all give metres
SAFE: Final = {"use_safetensors": True, "trust_remote_code": False}  # no pickles, and no code beside the weights
Array = np.ndarray[Any, Any]


def estimate_depth(name: str, rgb: Array) -> Array:
    """Return ``[height, width]`` float32 metres that a model sees in a picture.

    Args:
        name: a folder, or an id of the hub, which is downloaded when it is not in the hub's cache.
        rgb: ``[height, width, 3]`` uint8.

    Raises:
        DataError: when the model cannot be loaded, or gives depth without a unit.
    """
    import torch
    from PIL import Image
    from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation

    with busy("estimating depth"):
        try:
            config = AutoConfig.from_pretrained(name, trust_remote_code=False)
            processor = AutoImageProcessor.from_pretrained(name, trust_remote_code=False)
            check_metric(name, config)
            model = AutoModelForDepthEstimation.from_pretrained(name, **SAFE).eval()
        except (OSError, ValueError, ImportError) as error:
            kind = "folder" if Path(name).is_dir() else "folder or model of the hub"
            raise DataError(f"--depth-model {name}: no usable {kind} ({str(error).strip().splitlines()[0]})") from error
        inputs = processor(images=Image.fromarray(rgb), return_tensors="pt")
        with torch.inference_mode():
            outputs = model(**inputs)
        sized = processor.post_process_depth_estimation(outputs, target_sizes=[rgb.shape[:2]])
    depth: Array = sized[0]["predicted_depth"].float().numpy()
    return depth


def check_metric(name: str, config: Any) -> None:
    """Raise ``DataError`` when a model's depth has no unit, as that of models trained on many kinds of data."""
    if config.model_type not in METRIC and getattr(config, "depth_estimation_type", "relative") != "metric":
        raise DataError(f"--depth-model {name}: its depth has no unit; {ADVICE}")
