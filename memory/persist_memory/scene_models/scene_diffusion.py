"""The model of scenes: a codec from cells to latents, and a diffusion transformer that fills windows of them.

What interactions change a third network says (``outcome``), if the model was trained for that.

Training follows PERSIST (arXiv 2603.03482): rectified flow on velocities, with noise levels of their own for regions,
so that known places are clean where others are noise. Sampling takes Euler steps. At the end, or after each step as in
PERSIST, the prediction is decoded, given cells are written into it, and it is snapped to classes.

Blocks and steps are our own, where diffusers has others: its ``BasicTransformerBlock`` modulates all tokens of a sample
alike and has no rotary positions, and its ``FlowMatchEulerDiscreteScheduler`` adds noise of one level of its table to
a whole sample, where regions have levels of their own. Where nothing is given, a sample takes the steps of that
scheduler. Importing it takes 1.3 times as long as torch (``tests/benchmarks/bench_imports.py``).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from persist_cli.api.cells import COMMON, FREE, OUTSIDE, SOLID, is_solid
from persist_cli.api.cpu_attention import products_for_training
from persist_cli.api.scene_model import Given, SceneForm, SceneModel, SceneSamples
from persist_cli.api.stages import SCENE_STAGES, ParameterGroup, Stage
from persist_cli.io.files import load_exactly, read_tensors, write_tensors
from persist_memory.scene_models.codec import SceneCodec, folded_tokens, unfold
from persist_memory.scene_models.conditions import (
    ActionEmbedding,
    GivenCells,
    ViewTokens,
    changed_tokens,
    content,
    draw_levels,
    known_tokens,
    shifted,
    token_weights,
    told_weights,
    truth,
)
from persist_memory.scene_models.outcome import Outcome
from persist_memory.scene_models.settings import SceneDiffusionSettings
from persist_memory.scene_models.specks import least_cells, without_specks
from persist_memory.scene_models.transformer import SceneTransformer

PARTS: dict[Stage, tuple[str, ...]] = {  # of the model, which the stages train
    "scene-codec": ("codec",),
    "scene": ("given", "view", "action", "transformer"),
    "scene-outcome": ("outcomes",),
}
FILES: dict[Stage, str] = {
    "scene-codec": "codec.safetensors",
    "scene": "transformer.safetensors",
    "scene-outcome": "outcome.safetensors",
}
COMMONEST = (*COMMON, "floor", "ceiling", "wall")  # cells of all other classes, doors and things, are few


@dataclass(frozen=True)
class Told:
    """What the transformer is told, embedded once for all steps.

    Args:
        given: of the cells of each token.
        view: tokens of the view.
        action: of action and camera.
    """

    given: Float[Tensor, "batch token channel"]
    view: Float[Tensor, "batch view channel"]
    action: Float[Tensor, "batch channel"]


class SceneDiffusion(SceneModel):
    """Fills windows of cells by diffusion in the latents of a codec."""

    settings_type = SceneDiffusionSettings
    stages = SCENE_STAGES
    settled = MappingProxyType({"scene-codec": "codec", "scene": "transformer"})
    settings: SceneDiffusionSettings
    weights: Tensor

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__(settings)
        self.codec = SceneCodec(settings)
        self.given, self.view = GivenCells(settings), ViewTokens(settings)
        self.action, self.transformer = ActionEmbedding(settings), SceneTransformer(settings)
        self.outcomes, self.knows_outcomes = Outcome(settings), False
        rare = [1.0 if name in COMMONEST else settings.codec.rare_weight for name in settings.palette]
        self.register_buffer("weights", torch.tensor(rare), persistent=False)

    @property
    def form(self) -> SceneForm:
        """The windows of the settings."""
        return self.settings.form

    def forward(self, samples: SceneSamples, stage: Stage) -> dict[str, Tensor]:
        """Return the losses of the codec, of the transformer on the codec's latents, or of what interactions change."""
        generators = generators_of(samples)
        if stage == "scene-outcome":
            return self.outcomes.loss(samples, generators)
        return self._code(samples, generators) if stage == "scene-codec" else self._diffuse(samples, generators)

    def _code(self, samples: SceneSamples, generators: list[torch.Generator]) -> dict[str, Tensor]:
        """The loss of the codec, each part a mean over cells, in which those that the data do not tell count less."""
        classes, colors = truth(samples)
        mean, logarithm = (part.float() for part in self.codec.posterior(classes, colors))
        drawn = mean + (0.5 * logarithm).exp() * noise_like(mean, generators)
        spread = drawn.detach().flatten(2).std(2)[(...,) + (None,) * self.codec.axes]
        share = self.settings.codec.noise
        noisy = (1 - share) * drawn + share * spread * noise_like(mean, generators)
        logits, predicted = self.codec.read_off(noisy)
        surprise = F.cross_entropy(logits.flatten(0, 3), classes.flatten().long(), reduction="none")
        weights = self.weights[classes.flatten().int()] * told_weights(samples, self.settings).flatten()
        cross_entropy = (surprise * weights).sum() / weights.sum()
        solid = is_solid(classes)
        color_error = ((predicted - colors / 255).abs().mean(-1) * solid).sum() / solid.sum().clamp_min(1)
        divergence = 0.5 * (mean**2 + logarithm.exp() - 1 - logarithm).sum() / classes.numel()
        own = self.settings.codec
        loss = cross_entropy + own.color_weight * color_error + own.kl_weight * divergence
        likeliest = (logits.detach() - self.weights.log()).argmax(-1)
        wrong = ((likeliest != classes) & solid).sum() / solid.sum().clamp_min(1)
        return {
            "loss": loss, "cross_entropy": cross_entropy, "color_error": color_error, "divergence": divergence,
            "wrong_solid": wrong,
        }  # fmt: skip

    def _diffuse(self, samples: SceneSamples, generators: list[torch.Generator]) -> dict[str, Tensor]:
        """The squared error of the velocities of all tokens that are not known; less of what the data do not tell."""
        known = known_tokens(samples, self.settings)
        levels = draw_levels(self.settings, generators).to(known.device).masked_fill(known, 0.0)
        held = self._held(samples)
        latents = self._latents(samples, held, known, levels)
        noise = noise_like(latents, generators)
        dropped = torch.cat([torch.rand(1, generator=generator) for generator in generators])
        told = self.tell(samples, held, generators, dropped < self.settings.transformer.drop_view)
        noisy = self._mix(latents, noise, levels, known)
        with products_for_training(noisy):
            velocity = self.transformer(noisy, levels, told.given, told.view, told.action).float()
        errors = self._tokens(velocity - (noise - latents)).square().mean(-1)
        weights = (~known).float()
        weights *= token_weights(samples, self.settings)
        weights *= 1 + (self.settings.transformer.change_weight - 1) * changed_tokens(samples, self.settings)
        loss = (errors * weights).sum() / weights.sum().clamp_min(1)
        return {"loss": loss, "known_tokens": known.float().mean()}

    @torch.no_grad()
    def _held(self, samples: SceneSamples) -> Float[Tensor, "batch channel *latent"]:
        """Latents of what is given."""
        return self.codec.encode(*start(samples, self.settings)).float()

    @torch.no_grad()
    def _latents(
        self,
        samples: SceneSamples,
        held: Float[Tensor, "batch channel *latent"],
        known: Bool[Tensor, "batch token"],
        levels: Float[Tensor, "batch token"],
    ) -> Float[Tensor, "batch channel *latent"]:
        """Latents of the truth; known tokens hold what they hold in sampling.

        A latent knows of its neighbours. Before the first snap sampling knows nothing beside the given cells, and the
        truth there must not leak into the latents of these.
        """
        own = self.settings.sampling
        snapped_from = own.snap_below if own.snap_every else -1.0
        early = known & (levels.amax(1, keepdim=True) > snapped_from)
        return held.where(self._places(early.float()).bool(), self.codec.encode(*truth(samples)).float())

    def tell(
        self,
        samples: SceneSamples,
        held: Float[Tensor, "batch channel *latent"],
        generators: list[torch.Generator],
        dropped: Bool[Tensor, " batch"],
    ) -> Told:
        """Return the embedded conditions.

        Args:
            samples: the conditions.
            held: latents of what is given.
            generators: of the samples' noise, in training and in sampling alike.
            dropped: whose view is left out.
        """
        share = self.settings.transformer.condition_noise
        colors = torch.empty(len(samples.rgb), 3, *samples.depth.shape[-2:], device=samples.rgb.device)
        view = self.view(samples, noise_like(colors, generators), share)
        action = self.action(samples, self.view.rays(samples)[0][:, :, 0, 0])
        return Told(self.given(samples, held), self.view.without(view, dropped), action)

    @torch.no_grad()
    def sample(
        self, samples: SceneSamples, steps: int
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return classes and colours of all cells; see ``SceneModel.sample``."""
        generators, own = generators_of(samples), self.settings.sampling
        known = known_tokens(samples, self.settings)
        held = clean = self._held(samples)  # what known tokens hold
        rest = noise = noise_like(clean, generators)
        told, fixed = self._tell_guided(samples, held, generators), self._places(known.float()).bool()
        for step, (level, following) in enumerate(pairwise(noise_levels(steps, own.shift)), start=1):
            of_tokens = torch.full(known.shape, level, device=known.device).masked_fill(known, 0.0)
            latents = self._mix(held.where(fixed, clean), noise.where(fixed, rest), of_tokens, known)
            velocity = self._velocity(latents, of_tokens, told)
            clean, rest = latents - level * velocity, latents + (1 - level) * velocity
            if own.snap_every and step % own.snap_every == 0 and 0 < following <= own.snap_below:
                held = clean = self.codec.encode(*self._snapped(held.where(fixed, clean), samples))
        return self._snapped(held.where(fixed, clean), samples)

    def _velocity(self, latents: Tensor, levels: Tensor, told: tuple[Told, Told | None]) -> Tensor:
        """The velocities, away from those without a view where guidance is on."""
        seen, unseen = told
        velocity: Tensor = self.transformer(latents, levels, seen.given, seen.view, seen.action).float()
        if unseen is None:
            return velocity
        plain: Tensor = self.transformer(latents, levels, unseen.given, unseen.view, unseen.action).float()
        return plain + self.settings.sampling.guidance * (velocity - plain)

    def _tell_guided(
        self, samples: SceneSamples, held: Tensor, generators: list[torch.Generator]
    ) -> tuple[Told, Told | None]:
        """The conditions, and those without a view where guidance is on."""
        everyone = torch.ones(len(samples.given), dtype=torch.bool)
        seen = self.tell(samples, held, generators, ~everyone)
        if self.settings.sampling.guidance == 1:
            return seen, None
        return seen, Told(seen.given, self.view.without(seen.view, everyone), seen.action)

    def _mix(
        self,
        clean: Float[Tensor, "batch channel *latent"],
        noise: Float[Tensor, "batch channel *latent"],
        levels: Float[Tensor, "batch token"],
        known: Bool[Tensor, "batch token"],
    ) -> Float[Tensor, "batch channel *latent"]:
        """Latents at noise levels, known ones with the noise of conditions."""
        share = self._places(levels.masked_fill(known, self.settings.transformer.condition_noise))
        return (1 - share) * clean + share * noise

    def _places(self, of_tokens: Float[Tensor, "batch token"]) -> Float[Tensor, "batch 1 *latent"]:
        """A value of each token as one of each latent."""
        patch, tokens = self.settings.transformer.patch, self.settings.tokens
        values = of_tokens.unflatten(1, tokens)[:, None]
        return unfold(values.expand(-1, patch ** len(tokens), *[-1] * len(tokens)), patch)

    def _tokens(self, latents: Float[Tensor, "batch channel *latent"]) -> Float[Tensor, "batch token folded"]:
        return folded_tokens(latents, self.settings.transformer.patch)

    def _snapped(
        self, latents: Float[Tensor, "batch channel *latent"], samples: SceneSamples
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Decode latents to the likeliest class of each cell, and write what is given into it."""
        logits, colors = self._decoded(latents)
        given = kept = content(samples)
        if self.settings.is_named:  # what is only known to be solid is the likeliest thing that it can be
            unnamed = given & (samples.classes == SOLID)
            things = logits.index_fill(-1, torch.tensor([FREE, OUTSIDE], device=logits.device), -torch.inf)
            logits, kept = torch.where(unnamed[..., None], things, logits), given & ~unnamed
        classes = torch.where(kept, samples.classes, logits.argmax(-1).to(torch.uint8))
        same = (samples.given == Given.PAST) & (classes == samples.classes)  # also what was small before
        parts = zip(logits, classes, kept | same, strict=True)
        classes = torch.stack([without_specks(*part, self.codec.least_cells) for part in parts])
        return classes, torch.where(given[..., None], samples.colors, painted(classes, colors))

    @torch.no_grad()
    def outcome(
        self, samples: SceneSamples
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]] | None:
        """Return the windows after the interactions, if the model was trained on these; see ``SceneModel.outcome``."""
        return self.outcomes.after(samples) if self.knows_outcomes else None

    @torch.no_grad()
    def reconstruct(
        self, classes: UInt8[Tensor, "batch first second level"], colors: UInt8[Tensor, "batch first second level 3"]
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return the cells as the codec's latents hold them; see ``SceneModel.reconstruct``.

        What is solid, and of no known class, is taken for what it is taken for in sampling.
        """
        logits, decoded = self._decoded(self.codec.encode(named(classes, self.settings), colors))
        classes = logits.argmax(-1).to(torch.uint8)
        return classes, painted(classes, decoded)

    def _decoded(self, latents: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of classes, where things have names never of ``SOLID``, and colours (1 = 255).

        The codec is trained as if there were ``rare_weight`` times as many doors and things. Read off as that, each
        uncertain door would be one: a piece of wall above a way that is not free.
        """
        logits, colors = self.codec.decode(latents)
        logits -= self.codec.class_weights.log()
        if self.settings.is_named:
            logits[..., SOLID] = -torch.inf
        return logits, colors

    def finish_stage(self, stage: Stage, batches: Iterable[SceneSamples]) -> None:
        """Measure latents and pieces of the classes after the codec's stage, and keep what each class counted."""
        if stage == "scene-codec":
            cells = [truth(batch) for batch in batches]
            self.codec.class_weights.copy_(self.weights)
            windows = torch.cat([classes for classes, _ in cells])
            self.codec.least_cells.copy_(least_cells(windows, len(self.settings.palette)))
            with torch.no_grad():
                self.codec.measure([self.codec.posterior(*part)[0] for part in cells])

    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Freeze all parameters that the stage does not train, and return the others by name."""
        self.requires_grad_(False)
        for name in PARTS[stage]:
            self.get_submodule(name).requires_grad_(True)
        return {name: parameter for name, parameter in self.named_parameters() if parameter.requires_grad}

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the parameters by the parts of the model."""
        return [
            ParameterGroup(part, {f"{part}.{name}": value for name, value in module.named_parameters()})
            for part, module in ((part, self.get_submodule(part)) for parts in PARTS.values() for part in parts)
        ]

    def save(self, folder: Path, stage: Stage) -> None:
        """Write the parts of the stages up to this one, those of each into a safetensors file."""
        for trained in stages_to(stage):
            write_tensors(folder / FILES[trained], self._tensors_of(trained))

    def load(self, folder: Path, stage: Stage) -> None:
        """Load the parts of the stages up to this one."""
        for trained in stages_to(stage):
            path = folder / FILES[trained]
            load_exactly(self, read_tensors(path)[0], set(self._tensors_of(trained)), path)
        self.knows_outcomes = stage == "scene-outcome"
        if self.weights.is_meta:
            self.weights = type(self)(self.settings).weights

    def _tensors_of(self, stage: Stage) -> dict[str, Tensor]:
        parts = PARTS[stage]
        return {name: tensor for name, tensor in self.state_dict().items() if name.partition(".")[0] in parts}


def stages_to(stage: Stage) -> tuple[Stage, ...]:
    """Return the stages up to this one."""
    return SCENE_STAGES[: SCENE_STAGES.index(stage) + 1]


def generators_of(samples: SceneSamples) -> list[torch.Generator]:
    """Return a CPU generator for each sample, so that a sample does not depend on its batch or device."""
    return [torch.Generator().manual_seed(int(seed)) for seed in samples.seeds]


def noise_like(values: Tensor, generators: list[torch.Generator]) -> Tensor:
    """Draw normal noise, each sample from its own generator, float32."""
    drawn = [torch.randn(values.shape[1:], generator=generator) for generator in generators]
    return torch.stack(drawn).to(values.device)


def noise_levels(steps: int, shift: float) -> list[float]:
    """Return the noise levels of so many Euler steps, from 1 to 0; a shift above 1 moves them up."""
    even = torch.tensor([1 - step / steps for step in range(steps + 1)], dtype=torch.float64)
    return [float(level) for level in shifted(even, shift)]


def start(samples: SceneSamples, settings: SceneDiffusionSettings) -> tuple[Tensor, Tensor]:
    """Return what sampling knows before its first step: what is given or was there before, and no room elsewhere.

    What is solid, and of no known class, is taken for a floor at the lowest level, a ceiling at the highest, and for a
    wall between them, where things have names.
    """
    told = samples.given != Given.NOTHING
    return named(samples.classes, settings).where(told, OUTSIDE), samples.colors * told[..., None]


def named(classes: UInt8[Tensor, "*batch level"], settings: SceneDiffusionSettings) -> UInt8[Tensor, "*batch level"]:
    """Return classes with a guess, by its level, where something is solid and of no known class."""
    guesses = torch.tensor(guessed_levels(settings), dtype=torch.uint8, device=classes.device)
    return torch.where(classes == SOLID, guesses, classes)


def guessed_levels(settings: SceneDiffusionSettings) -> list[int]:
    """Return for each level the class that something solid most likely has there."""
    palette, levels = settings.palette, settings.shape[2]
    names = ["floor", *["wall"] * (levels - 2), "ceiling"][:levels]
    return [palette.index(name) if name in palette else SOLID for name in names]


def painted(classes: UInt8[Tensor, "*batch"], colors: Float[Tensor, "*batch 3"]) -> UInt8[Tensor, "*batch 3"]:
    """Return decoded colours (1 = 255) of cells, 0 where nothing is."""
    return (colors.clamp(0, 1) * 255).round().to(torch.uint8) * is_solid(classes)[..., None]
