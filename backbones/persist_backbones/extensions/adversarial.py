"""Adversarial training: a discriminator tells predicted clips from true ones, and the model learns to pass for true.

The squared error of denoising is least for the mean of all that may follow, a blur where much may; a model of few steps
and little training shows it. Here the model predicts clean latents in one step from the noise of one of sampling's
levels (ADD, Sauer et al., 2311.17042), and a discriminator of latents (LADD, 2403.12015), who sees what the given frame
shows too, compares each prediction with the truth of its clip (relativistic, 1807.00734). Its scores are kept from
being steep at true and at predicted clips (the penalties R1 and R2, as in R3GAN, 2501.05441), for a discriminator that
is always right teaches nothing. Both learn in the same step: either loss takes the other's weights as constants.

The discriminator pulls the prediction of each clip as strongly, in proportion, as the loss of denoising does: the
gradients of the two are compared where they meet, at the prediction (as VQGAN does for a batch at its last layer,
2012.09841). So how strong its scores are does not matter, and a sample counts the same in any batch.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, softplus

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.diffusion import (
    NoisedPrediction,
    draw_among,
    loss_parts,
    make_scheduler,
    sample_generators,
)
from persist_cli.api.backbone import Clips
from persist_cli.api.stages import Adversarial
from persist_cli.errors import RecipeError

SMALLEST: Final = 4  # rows or columns of the map of scores; above twice as many it is halved
WIDEST: Final = 4  # times the width of the first layer
SLOPE: Final = 0.2  # of the rectifiers below zero


class ClipBlock(nn.Module):
    """A residual block that mixes pixels of each frame, and then each place's frames.

    Args:
        channels: number of channels before.
        out: number of channels after.
        stride: 2 halves height and width.
    """

    def __init__(self, channels: int, out: int, stride: int) -> None:
        super().__init__()
        strides = (1, stride, stride)
        self.space = nn.Conv3d(channels, out, (1, 3, 3), strides, (0, 1, 1))
        self.time = nn.Conv3d(out, out, (3, 1, 1), padding=(1, 0, 0))
        self.skip = nn.Conv3d(channels, out, 1, strides)

    def forward(self, clips: Tensor) -> Tensor:
        """Return the features of the block, axes batch, channel, frame, height, width."""
        mixed = self.time(leaky_relu(self.space(clips), SLOPE))
        return leaky_relu(self.skip(clips) + mixed, SLOPE)


class Discriminator(nn.Module):
    """Scores clips of latents: higher where they look true, for each frame and place.

    Args:
        channels: number of channels of the latents.
        size: their height and width.
        width: number of channels of the first block.
    """

    def __init__(self, channels: int, size: tuple[int, int], width: int) -> None:
        super().__init__()
        widths, edge = [width, width], min(size)
        while edge >= 2 * SMALLEST:
            widths.append(min(2 * widths[-1], WIDEST * width))
            edge = -(-edge // 2)  # as the convolutions round
        blocks = [ClipBlock(*pair, stride=1 if not number else 2) for number, pair in enumerate(pairwise(widths))]
        self.layers = nn.Sequential(nn.Conv3d(2 * channels, width, 1), *blocks, nn.Conv3d(widths[-1], 1, 1))

    def forward(
        self,
        clips: Float[Tensor, "batch frame channel height width"],
        image: Float[Tensor, "batch frame channel height width"],
    ) -> Float[Tensor, "batch 1 frame rows columns"]:
        """Return the scores of clips whose given frames show ``image``."""
        scores: Tensor = self.layers(torch.cat([clips, image], dim=2).transpose(1, 2))
        return scores


def make_discriminator(model: CogVideoX, settings: Adversarial) -> Discriminator:
    """Make a discriminator for a model's latents.

    Raises:
        RecipeError: for more levels than the model was trained with.
    """
    trained = model.scheduler.config.num_train_timesteps
    if settings.steps > trained:
        raise RecipeError(f"adversarial.steps={settings.steps}: this model was trained with {trained} noise levels")
    return Discriminator(compared_channels(model), (model.shape.height, model.shape.width), settings.width)


def compared_channels(model: CogVideoX) -> int:
    """Return how many channels of latents are compared: those of RGB, and of depth where the model predicts any."""
    return len(model.channel_weights()) if model.settings.depth else model.codec.channels


def adversarial_loss(
    model: CogVideoX, clips: Clips, discriminator: Discriminator, settings: Adversarial
) -> dict[str, Tensor]:
    """Return the loss of a batch for both, its parts of RGB and depth, and how well the discriminator tells them apart.

    ``discriminator`` among the parts is its loss without the penalty: log 2 where it cannot, 0 where it always can.
    """
    generators, clips = sample_generators(clips.seeds), clips.to(model.device)
    prediction = model.predict_noised(clips, generators, partial(draw_among, sampled_timesteps(model, settings)))
    losses = loss_parts(model.weighted_error(prediction), model.settings.depth)
    with torch.autocast(model.device.type, enabled=False):
        true, predicted, image = to_compare(model, clips, prediction)
        apart, steep, pull = discriminator_loss(discriminator, true, predicted, image)
        (denoising,) = torch.autograd.grad(losses["loss"], prediction.predicted, retain_graph=True)
        (passing,) = torch.autograd.grad(predicted, prediction.predicted, pull, retain_graph=True)
        towards = directed(prediction.predicted, settings.weight * as_long_as(denoising, passing))
    total = losses["loss"] + towards + apart + settings.penalty * steep
    return losses | {"loss": total, "discriminator": apart}


def as_long_as(one: Float[Tensor, "batch ..."], other: Float[Tensor, "batch ..."]) -> Float[Tensor, "batch ..."]:
    """Return the other gradient with the length of the one, for each sample by itself; 0 where it is 0."""
    lengths = [torch.linalg.vector_norm(part.float().flatten(1), dim=1) for part in (one, other)]
    scale = torch.where(lengths[1] > 0, lengths[0] / lengths[1], 0.0)
    return other.float() * scale.view(-1, *[1] * (other.ndim - 1))


def directed(predicted: Tensor, gradient: Tensor) -> Tensor:
    """Return a loss of value 0 with this gradient to a prediction."""
    return (gradient.detach() * (predicted.float() - predicted.detach().float())).sum()


def sampled_timesteps(model: CogVideoX, settings: Adversarial) -> Int[Tensor, " step"]:
    """The timesteps at which the sampler of the trained model predicts."""
    timesteps: Tensor = make_scheduler(model.scheduler.config, "ddim", settings.steps).timesteps
    return timesteps


def to_compare(model: CogVideoX, clips: Clips, prediction: NoisedPrediction) -> tuple[Tensor, Tensor, Tensor]:
    """Return true and predicted latents of the frames after the given one, and what that shows in their views.

    The given frame itself is left out: beside it every predicted one would be known by its finest detail. Channels have
    the weight in the squared distance of two clips that the loss of denoising gives them; those of depth are left out
    for a model without depth, whose predictions of them nothing has trained.
    """
    shape, channels = model.shape.of(clips), compared_channels(model)
    scale = model.channel_weights()[:channels].sqrt()
    latents = (prediction.noised.clean, prediction.clean(model.scheduler))
    true, predicted = (shape.drop_padding(part)[:, 1:, :channels] * scale for part in latents)
    image = prediction.noised.image[:, :, :channels].float() * scale
    alone = model.settings.given == "alone"  # nothing is said of later frames
    return true, predicted, image[:, :1].expand_as(true) if alone else shape.drop_padding(image)[:, 1:]


def discriminator_loss(
    discriminator: Discriminator,
    true: Float[Tensor, "batch frame channel height width"],
    predicted: Float[Tensor, "batch frame channel height width"],
    image: Float[Tensor, "batch frame channel height width"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return how badly true and predicted clips are told apart, how steep their scores are, and the pull.

    The pull is the gradient to the predicted clips of the loss of not passing for true.

    Args:
        discriminator: gives the scores.
        true: the true latents.
        predicted: the predicted ones.
        image: latents of the image condition of both.
    """
    true, predicted = (clips.detach().requires_grad_() for clips in (true, predicted))
    true_scores, predicted_scores = (discriminator(clips, image) for clips in (true, predicted))
    steep = steepness(true_scores, true) + steepness(predicted_scores, predicted)
    (pull,) = torch.autograd.grad(
        softplus(true_scores.detach() - predicted_scores).mean(), predicted, retain_graph=True
    )
    return softplus(predicted_scores - true_scores).mean(), steep, pull


def steepness(
    scores: Float[Tensor, "batch 1 frame rows columns"], clips: Float[Tensor, "batch frame channel height width"]
) -> Tensor:
    """Return the squared length of the gradient of the frames' mean scores to the clips, for each frame."""
    frames = scores.mean(dim=(3, 4))
    (gradient,) = torch.autograd.grad(frames.sum(), clips, create_graph=True)
    return gradient.square().sum(dim=(2, 3, 4)).mean()
