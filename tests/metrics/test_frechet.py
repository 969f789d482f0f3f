"""The Fréchet distance against closed forms and a matrix square root."""

import pytest
import torch

from persist_cli.errors import DataError
from persist_cli.metrics.fvd import frechet_distance


def draw_features(seed: int, samples: int, channels: int) -> torch.Tensor:
    """Correlated features of unequal spread."""
    draw = torch.Generator().manual_seed(seed)
    mixing = torch.randn(channels, channels, generator=draw, dtype=torch.float64) * torch.linspace(0.1, 2, channels)
    return torch.randn(samples, channels, generator=draw, dtype=torch.float64) @ mixing + seed


def moments(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return features.mean(0), torch.cov(features.T)


def distance_by_scipy(one: torch.Tensor, other: torch.Tensor) -> float:
    linalg = pytest.importorskip("scipy.linalg")
    (mean, covariance), (other_mean, other_covariance) = moments(one), moments(other)
    root = linalg.sqrtm((covariance @ other_covariance).numpy()).real
    shift = (mean - other_mean).square().sum()
    return float(shift + covariance.trace() + other_covariance.trace() - 2 * root.trace())


@pytest.mark.parametrize("samples", [(50, 70), (40, 300), (1000, 40)])
def test_the_distance_equals_scipys_matrix_square_root(samples):
    one, other = (draw_features(seed, count, 20) for seed, count in enumerate(samples))
    assert frechet_distance(one, other) == pytest.approx(distance_by_scipy(one, other), rel=1e-9)


def features_with_moments(mean: torch.Tensor, deviations: torch.Tensor) -> torch.Tensor:
    """Samples of exactly this mean and these uncorrelated deviations."""
    centred = draw_features(1, 10, len(mean)) - draw_features(1, 10, len(mean)).mean(0)
    white = torch.linalg.qr(centred).Q * 3  # of unit variance: nine degrees of freedom
    return white * deviations + mean


def test_known_gaussians_have_the_closed_form():
    one = features_with_moments(torch.tensor([0.0, 1.0, 2.0]), torch.tensor([2.0, 3.0, 0.5]))
    other = features_with_moments(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([1.0, 4.0, 0.0]))
    expected = 5 + (2 - 1) ** 2 + (3 - 4) ** 2 + 0.5**2  # diagonal: |shift|² + Σ (σ₁ − σ₂)²
    assert frechet_distance(one, other) == pytest.approx(expected)


def test_equal_covariances_leave_the_distance_of_the_means():
    features = draw_features(0, 40, 12)
    shift = torch.arange(12.0)
    assert frechet_distance(features, features + shift) == pytest.approx(float(shift.square().sum()))


@pytest.mark.parametrize("samples", [2, 6, 100, 1000])
def test_a_set_of_any_rank_has_no_distance_from_itself(samples):
    features = draw_features(0, samples, 100)
    scale = float(features.var(0).sum())
    assert frechet_distance(features, features) <= 1e-12 * scale
    assert frechet_distance(features, features.flip(0)) <= 1e-9 * scale


def test_fewer_samples_than_channels_give_what_the_covariances_give():
    one, other = draw_features(0, 7, 60), draw_features(1, 9, 60)
    assert frechet_distance(one, other) == pytest.approx(distance_by_scipy(one, other), rel=1e-6)


def test_the_distance_is_symmetric_and_unmoved_by_a_rotation():
    one, other = draw_features(0, 30, 40), draw_features(1, 60, 40)
    rotation = torch.linalg.qr(draw_features(2, 40, 40)).Q
    distance = frechet_distance(one, other)
    assert frechet_distance(other, one) == pytest.approx(distance, rel=1e-9)
    assert frechet_distance(one @ rotation, other @ rotation) == pytest.approx(distance, rel=1e-9)


def test_resamples_that_repeat_one_video_are_finite():
    one, other = draw_features(0, 6, 400), draw_features(1, 6, 400)
    assert frechet_distance(one[[2] * 6], other[[2] * 6]) == pytest.approx(float((one[2] - other[2]).square().sum()))


def test_sets_without_a_covariance_are_one_line():
    features = draw_features(0, 6, 5)
    holes = features.clone()
    holes[2, 2] = float("nan")
    for one, other, cause in (
        (features[:1], features, "at least two samples"),
        (features, draw_features(0, 6, 4), r"\[6, 5\] and \[6, 4\]"),
        (features, holes, "the second features are not finite"),
    ):
        with pytest.raises(DataError, match=cause):
            frechet_distance(one, other)
