"""Metrics of generated videos, each with a name and a definition that is printed beside its figures."""

from persist_cli.metrics.camera_control import RotationError, TranslationError
from persist_cli.metrics.depth import AbsRel, Delta1, Rmse
from persist_cli.metrics.dreamsim import DreamSim
from persist_cli.metrics.drift import Drift
from persist_cli.metrics.frames import Psnr, Ssim
from persist_cli.metrics.fvd import Fvd
from persist_cli.metrics.kernel_distance import KernelDistance
from persist_cli.metrics.lpips import LpipsAlex, LpipsVgg
from persist_cli.metrics.metric import Metric
from persist_cli.metrics.own_visit import LpipsOwn, PsnrOwn
from persist_cli.metrics.sharpness import Grain, Sharpness
from persist_cli.metrics.src import Src, SrcAway, SrcPatch

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Psnr(), Sharpness(), Grain(), Ssim(), LpipsAlex(), LpipsVgg(), DreamSim(), Fvd(), KernelDistance(), Src(),
        SrcPatch(), SrcAway(), PsnrOwn(), LpipsOwn(), AbsRel(), Rmse(), Delta1(), Drift(), RotationError(),
        TranslationError(),
    )
}  # fmt: skip
