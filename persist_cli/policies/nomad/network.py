"""NoMaD's network: what was seen and the goal become one token; a diffusion of waypoints and a distance follow it.

Differences from the published training, each for a reason: the error of the distance counts for each sample whose goal
is not masked (there a mean over the whole batch is weighed by the share of these), and what is masked, noise and its
level follow from a sample's own seed, whatever its batch. What is dropped out does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import torch
from jaxtyping import Bool, Float, UInt8
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from persist_cli.api.policy_network import PolicyNetwork, PolicySamples, SampleForm
from persist_cli.api.stages import ParameterGroup
from persist_cli.io.files import load_exactly, read_tensors, write_tensors
from persist_cli.policies.nomad.efficientnet import EfficientNet, EncoderSettings
from persist_cli.policies.nomad.matcher import Matcher
from persist_cli.policies.nomad.unet import ConditionalUnet

if TYPE_CHECKING:
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

WEIGHTS: Final = "model.safetensors"
MEAN: Final = (0.485, 0.456, 0.406)  # of ImageNet
DEVIATION: Final = (0.229, 0.224, 0.225)
FARTHEST_PLACE: Final = 50.0  # metres
SMALLEST_SHARE: Final = 1e-2  # added to a share that a mean is divided by, as published

Positive = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Dropped = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True)
class NomadNetworkSettings:
    """The sizes of the network, those published by default, and the form of its samples.

    Args:
        height: pixels that images are resized to.
        width: pixels that images are resized to.
        context: frames before the present one.
        waypoints: places to come; a multiple of two for each level of the U-Net but the last.
        spacing: frames of a trajectory from one of these to the next.
        metres: of an agent's way in so many frames; waypoints are predicted in this unit.
        least: smallest motion from waypoint to waypoint, ahead and to the left, in this unit.
        most: largest motion from waypoint to waypoint.
        farthest: spacings to the farthest goal; goals of other trajectories are said to be as far.
        nearest: spacings to the goal above which waypoints are learned; up to it they may lead past the goal.
        negatives: share of the samples whose goal is a frame of another trajectory.
        still: metres; waypoints that all lie nearer than this are not learned. A place cannot tell a turn on the spot.
        masked: share of the samples whose goal is masked.
        distance_weight: weight of the distance's squared error; that of the noise has the rest.
        place_weight: weight of the error of where the goal lies; 0 as published, where nothing predicts it.
        encoder: both encoders of images.
        matcher: encoder whose maps of the present frame and the goal are compared place by place; ``None`` as
            published, where ``encoder`` sees both on top of each other.
        tokens: width of a token.
        layers: layers of the transformer.
        heads: heads of its attention.
        channels: channels of the levels of the U-Net.
        noise_levels: noise levels of the diffusion, which are its denoising steps too.
        dropout: share of an image's features that is dropped in training.
        drop_blocks: share of the samples for which the last block of an encoder is left out in training.
    """

    height: Annotated[int, Field(ge=32)] = 96
    width: Annotated[int, Field(ge=32)] = 96
    context: Count = 3
    waypoints: Positive = 8
    spacing: Positive = 1
    metres: Metres = 0.25
    least: tuple[float, float] = (-2.5, -4.0)
    most: tuple[float, float] = (5.0, 4.0)
    farthest: Positive = 20
    nearest: Count = 3
    negatives: Share = 0.05
    still: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    masked: Share = 0.5
    distance_weight: Share = 1e-4
    place_weight: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    encoder: EncoderSettings = field(default_factory=EncoderSettings)
    matcher: EncoderSettings | None = None
    tokens: Positive = 256
    layers: Positive = 4
    heads: Positive = 4
    channels: tuple[Positive, ...] = (64, 128, 256)
    noise_levels: Annotated[int, Field(ge=2)] = 10
    dropout: Dropped = 0.2
    drop_blocks: Dropped = 0.2

    def __post_init__(self) -> None:
        if not self.channels or self.waypoints % 2 ** (len(self.channels) - 1):
            raise ValueError(f"waypoints {self.waypoints} cannot be halved by each of {len(self.channels)} levels")
        if any(channels % 8 for channels in self.channels):
            raise ValueError(f"channels {list(self.channels)} must be multiples of 8")
        if self.tokens % 16 or self.tokens % self.heads:
            raise ValueError(f"tokens {self.tokens} must be a multiple of 16 and of heads {self.heads}")
        if not all(least < most for least, most in zip(self.least, self.most, strict=True)):
            raise ValueError(f"least {list(self.least)} must be below most {list(self.most)}")
        if self.nearest >= self.farthest:
            raise ValueError(f"nearest {self.nearest} must be below farthest {self.farthest}")


@dataclass(frozen=True)
class GoalPlace:
    """Where the goal's image was taken, as predicted.

    Args:
        ahead: metres ahead of the present camera.
        left: metres to the left of it.
        heading: degrees to the left of its heading.
        certainty: length of the predicted unit vector of the heading: 1 where one heading is certain, and the nearer to
            0 the farther apart those are that the network holds possible.
    """

    ahead: float
    left: float
    heading: float
    certainty: float

    @property
    def metres(self) -> float:
        """From the present camera, straight over the ground."""
        return math.hypot(self.ahead, self.left)


class NomadNetwork(PolicyNetwork):
    """Predicts where an agent goes next, and how far the goal is, from a few frames and the goal's image."""

    settings_type = NomadNetworkSettings
    settings: NomadNetworkSettings

    def __init__(self, settings: NomadNetworkSettings) -> None:
        super().__init__(settings)
        tokens, head = settings.tokens, settings.encoder.head
        self.seen_encoder = EfficientNet(settings.encoder, 3, settings.drop_blocks)
        self.goal_encoder = goal_encoder(settings)
        self.seen_token, self.goal_token = nn.Linear(head, tokens), nn.Linear(self.goal_encoder.width, tokens)
        layer = nn.TransformerEncoderLayer(
            tokens, settings.heads, 4 * tokens, activation="gelu", batch_first=True, norm_first=True
        )
        self.transformer = nn.TransformerEncoder(layer, settings.layers, enable_nested_tensor=False)
        self.noise = ConditionalUnet(settings.channels, tokens, tokens)
        self.distance = nn.Sequential(
            nn.Linear(tokens, tokens // 4), nn.ReLU(), nn.Linear(tokens // 4, tokens // 16), nn.ReLU(),
            nn.Linear(tokens // 16, 1),
        )  # fmt: skip
        place = nn.Sequential(nn.Linear(tokens, tokens), nn.ReLU(), nn.Linear(tokens, 4))
        self.place = place if settings.place_weight else None

    @property
    def sample_form(self) -> SampleForm:
        """Context, waypoints and goals as the settings say."""
        own = self.settings
        return SampleForm(own.context, own.waypoints, own.spacing, own.farthest, own.nearest, own.negatives)

    @cached_property
    def scheduler(self) -> DDPMScheduler:
        """The noise levels: squared cosine, noise predicted, samples clipped to -1…1."""
        from diffusers.schedulers.scheduling_ddpm import DDPMScheduler  # takes a second to import

        return DDPMScheduler(self.settings.noise_levels, beta_schedule="squaredcos_cap_v2", clip_sample=True)

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the parameters by the parts of the network."""
        return [
            ParameterGroup(part, {f"{part}.{name}": value for name, value in module.named_parameters()})
            for part, module in self.named_children()
        ]

    def forward(self, samples: PolicySamples, stage: str) -> dict[str, Tensor]:
        """Return the loss, and the errors of noise and distance that it is made of."""
        settings = self.settings
        masked, steps, noise = (part.to(samples.seen.device) for part in self._draw(samples.seeds))
        condition = self.condition(samples.seen, samples.goal, masked)
        motions = self.normalised(samples.waypoints)
        noisy = self.scheduler.add_noise(motions, noise, steps)
        noise_errors = (self.noise(noisy, steps, condition).float() - noise).square().mean((1, 2))
        moving = samples.waypoints.norm(dim=-1).amax(1) >= settings.still
        action = _mean_where(noise_errors, samples.leads_to_goal & moving)
        apart = (self.distance(condition).float()[:, 0] - samples.distance).square()
        distance = _mean_where(apart, ~masked)
        loss = settings.distance_weight * distance + (1 - settings.distance_weight) * action
        errors = {"noise_error": action, "distance_error": distance}
        if self.place is not None:
            known = samples.goal_place[:, 2:].any(1) & ~masked
            away = (self.place(condition).float() - squashed(samples.goal_place)).square().mean(1)
            errors["place_error"] = _mean_where(away, known)
            loss = loss + settings.place_weight * errors["place_error"]
        return {"loss": loss, **errors}

    def condition(
        self,
        seen: UInt8[Tensor, "batch frame height width 3"],
        goal: UInt8[Tensor, "batch height width 3"],
        masked: Bool[Tensor, " batch"],
    ) -> Float[Tensor, "batch token"]:
        """Return what waypoints and distance follow from.

        Args:
            seen: frames up to the present one, 0…255.
            goal: what is seen at the goal; not read where it is masked.
            masked: whether the goal is masked.
        """
        count, frames = seen.shape[:2]
        images = self._pixels(seen.flatten(0, 1))
        present = images.unflatten(0, (count, frames))[:, -1]
        pair = torch.cat([present, self._pixels(goal)], dim=1)
        token = self.goal_token(self._dropped(self.goal_encoder(pair)))
        tokens = self.seen_token(self._dropped(self.seen_encoder(images))).unflatten(0, (count, frames))
        tokens = torch.cat([tokens, token[:, None]], dim=1)
        places = sinusoids_interleaved(frames + 1, tokens.shape[-1]).to(tokens)
        hidden = torch.zeros(count, frames + 1, dtype=torch.bool, device=seen.device)
        hidden[:, -1] = masked
        tokens = self.transformer(tokens + places, src_key_padding_mask=hidden)
        weights = (~hidden).to(tokens.dtype)  # the mean over all but the masked ones
        mean: Tensor = (tokens * (weights / weights.sum(1, keepdim=True))[..., None]).sum(1)
        return mean

    @torch.no_grad()
    def sample(
        self,
        condition: Float[Tensor, " token"],
        count: int,
        steps: int,
        generator: torch.Generator,
    ) -> Float[Tensor, "count waypoint 2"]:
        """Return ``count`` samples of the waypoints, metres ahead and to the left, all denoised as one batch.

        Args:
            condition: a result of ``condition``.
            count: number of samples.
            steps: denoising steps, at most ``noise_levels``.
            generator: source of the noise, on the CPU.
        """
        shape = (count, self.settings.waypoints, 2)
        motions = torch.randn(shape, generator=generator).to(condition.device)
        self.scheduler.set_timesteps(steps)
        for step in self.scheduler.timesteps.tolist():
            level = torch.full((count,), step, device=motions.device)
            noise = self.noise(motions, level, condition.expand(count, -1))
            motions = self.scheduler.step(noise, step, motions, generator=generator).prev_sample
        return self.waypoints(motions)

    @torch.no_grad()
    def goal_place(self, condition: Float[Tensor, " token"]) -> GoalPlace | None:
        """Return where the goal lies; ``None`` of a network that has not learned it.

        Args:
            condition: a result of ``condition`` whose goal was not masked.
        """
        if self.place is None:
            return None
        predicted = self.place(condition).double().cpu()
        ahead, left = unsquashed(predicted[:2]).tolist()
        forward, aside = predicted[2:].tolist()
        return GoalPlace(ahead, left, math.degrees(math.atan2(aside, forward)), math.hypot(forward, aside))

    def normalised(self, waypoints: Float[Tensor, "batch waypoint 2"]) -> Float[Tensor, "batch waypoint 2"]:
        """Return the motions from waypoint to waypoint as numbers in -1…1."""
        motions = torch.diff(waypoints / self.settings.metres, dim=1, prepend=torch.zeros_like(waypoints[:, :1]))
        least, most = motions.new_tensor(self.settings.least), motions.new_tensor(self.settings.most)
        return (motions - least) / (most - least) * 2 - 1

    def waypoints(self, motions: Float[Tensor, "batch waypoint 2"]) -> Float[Tensor, "batch waypoint 2"]:
        """Return the waypoints in metres of motions that ``normalised`` gave."""
        least, most = motions.new_tensor(self.settings.least), motions.new_tensor(self.settings.most)
        return ((motions + 1) / 2 * (most - least) + least).cumsum(1) * self.settings.metres

    def save(self, folder: Path) -> None:
        """Write ``model.safetensors``."""
        write_tensors(folder / WEIGHTS, self.state_dict(), {"format": "pt"})

    def load(self, folder: Path) -> None:
        """Load ``model.safetensors``."""
        tensors, _ = read_tensors(folder / WEIGHTS)
        load_exactly(self, tensors, set(self.state_dict()), folder / WEIGHTS)

    def _draw(self, seeds: Any) -> tuple[Tensor, Tensor, Tensor]:
        """For each sample whether its goal is masked, its noise level and its noise."""
        rows = []
        for seed in seeds:
            draw = torch.Generator().manual_seed(seed)
            masked = torch.rand((), generator=draw) < self.settings.masked
            level = torch.randint(self.settings.noise_levels, (), generator=draw)
            rows.append((masked, level, torch.randn(self.settings.waypoints, 2, generator=draw)))
        masked_rows, levels, noise = zip(*rows, strict=True)
        return torch.stack(masked_rows), torch.stack(levels), torch.stack(noise)

    def _pixels(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch 3 height width"]:
        image, size = rgb.permute(0, 3, 1, 2).float() / 255, (self.settings.height, self.settings.width)
        if image.shape[-2:] != size:
            image = functional.interpolate(image, size=size, mode="bilinear", antialias=True, align_corners=False)
        return (image - image.new_tensor(MEAN)[:, None, None]) / image.new_tensor(DEVIATION)[:, None, None]

    def _dropped(self, features: Tensor) -> Tensor:
        return functional.dropout(features, self.settings.dropout, self.training)


def goal_encoder(settings: NomadNetworkSettings) -> EfficientNet | Matcher:
    """The encoder of the present frame together with the goal."""
    if settings.matcher is None:
        return EfficientNet(settings.encoder, 6, settings.drop_blocks)
    return Matcher(settings.matcher, (settings.height, settings.width))


def squashed(place: Float[Tensor, "batch 4"]) -> Float[Tensor, "batch 4"]:
    """The places of goals with their metres r as r / (1 + r), so that far goals count no more than near ones."""
    metres = place[:, :2].norm(dim=1, keepdim=True)
    return torch.cat([place[:, :2] / (1 + metres), place[:, 2:]], dim=1)


def unsquashed(place: Float[Tensor, " 2"]) -> Float[Tensor, " 2"]:
    """The place in metres of one that ``squashed`` gave; a prediction is at most ``FARTHEST_PLACE`` metres away."""
    share = float(place.norm())
    metres = min(share / (1 - min(share, 1 - 1e-6)), FARTHEST_PLACE)
    return place / max(share, 1e-6) * metres


def sinusoids_interleaved(places: int, width: int) -> Float[Tensor, "place width"]:
    """The positions of tokens: sine and cosine of each wavelength side by side (Vaswani et al. 2017)."""
    waves = torch.exp(torch.arange(0, width, 2) * (-torch.log(torch.tensor(10_000.0)) / width))
    angles = torch.arange(places)[:, None] * waves
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)


def _mean_where(errors: Float[Tensor, " batch"], counted: Bool[Tensor, " batch"]) -> Float[Tensor, ""]:
    """The mean error of the samples that count, or almost zero where none does."""
    share = counted.to(errors.dtype)
    return (errors * share).mean() / (share.mean() + SMALLEST_SHARE)
