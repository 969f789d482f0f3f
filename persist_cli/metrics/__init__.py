"""Metrics of generated videos, each with a name and a definition that is printed beside its figures."""

from persist_cli.metrics.depth import AbsRel, Delta1, Rmse
from persist_cli.metrics.dreamsim import DreamSim
from persist_cli.metrics.drift import Drift
from persist_cli.metrics.frames import Psnr, Ssim
from persist_cli.metrics.fvd import Fvd
from persist_cli.metrics.lpips import LpipsAlex, LpipsVgg
from persist_cli.metrics.metric import Metric
from persist_cli.metrics.src import Src, SrcAway

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Psnr(), Ssim(), LpipsAlex(), LpipsVgg(), DreamSim(), Fvd(), Src(), SrcAway(), AbsRel(), Rmse(), Delta1(),
        Drift(),
    )
}  # fmt: skip
