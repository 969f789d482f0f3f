"""The policy plugin ``nomad``: waypoints sampled by NoMaD's network, followed by the actions of the vocabulary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import torch
from pydantic import Field
from torch import Tensor

from persist_cli.api.actions import Action
from persist_cli.api.ground import Cover
from persist_cli.api.policy import Policy, Situation
from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.navigation.ways import way_is_free
from persist_cli.policies.nomad.network import NomadNetwork
from persist_cli.policies.nomad.tracking import follow_waypoints, go_straight_and_face
from persist_cli.policies.simple import gait
from persist_cli.policies.trained import find_policy, packaged_policy

STOP: Final = 2.0  # spacings

# of 1 to 3 metres, and certainties of 0.3 to 0.9: most success alone in 124 episodes of 10 validation houses
ARRIVE: Final = 2.0  # metres
SURE: Final = 0.5
SAMPLES: Final = 8
SOON: Final = 4  # actions of a sampled way that shall be free; an agent looks again after about as many


@dataclass(frozen=True)
class NomadSettings:
    """How a trained network acts.

    Args:
        checkpoint: run or folder of a trained policy; ``None`` for the one that comes with the package.
        steps: denoising steps, at least 2 and at most the network's noise levels; ``None`` for all. The scheduler would
            take a single one at the least noise, and return what it began with: nothing but noise.
        masked: whether the goal's image is not looked at, so that it explores.
        stop: predicted spacings of frames to the goal up to which it stops; 0 never stops.
        arrive: predicted metres to the goal's place up to which it goes straight there and turns to the goal's heading;
            0 follows waypoints to the end, as published. They say nothing of headings, and near the goal none were
            learned.
        sure: certainty of the predicted place from which that is done, see ``GoalPlace``.
        samples: ways that are sampled at least. Those whose beginning the known ground leaves free come first, and a
            goal behind something known is not gone straight to.
    """

    checkpoint: str | None = None
    steps: Annotated[int, Field(ge=2)] | None = None
    masked: bool = False
    stop: Annotated[float, Field(ge=0, allow_inf_nan=False)] = STOP
    arrive: Annotated[float, Field(ge=0, allow_inf_nan=False)] = ARRIVE
    sure: Annotated[float, Field(ge=0, le=1)] = SURE
    samples: Annotated[int, Field(ge=1)] = SAMPLES


class NomadPolicy(Policy):
    """Samples ways towards an image, or anywhere where there is none.

    The first is the straight way to the goal where the network is sure to be near it. Then come samples that the known
    ground leaves free, and then the others.

    Raises:
        PersistError: when the trained policy is not there, is of another architecture, or has fewer noise levels.
    """

    settings_type = NomadSettings
    network_type = NomadNetwork
    settings: NomadSettings

    def __init__(self, settings: NomadSettings) -> None:
        super().__init__(settings)
        trained = packaged_policy() if settings.checkpoint is None else find_policy(Path(settings.checkpoint))
        network = trained.load()
        if not isinstance(network, NomadNetwork):
            raise CheckpointError(f"{trained.folder}: is of policy {trained.plugin!r}, not 'nomad'")
        levels = network.settings.noise_levels
        if settings.steps is not None and settings.steps > levels:
            raise RecipeError(f"policy 'nomad': steps {settings.steps}; {trained.folder} has {levels} noise levels")
        self.network = network.to("cuda" if torch.cuda.is_available() else "cpu")
        self.steps = settings.steps or levels
        self.frames = network.settings.context * network.settings.spacing + 1

    @property
    def longest(self) -> int | None:
        """The frames that its waypoints look ahead."""
        return self.network.settings.waypoints * self.network.settings.spacing

    @torch.no_grad()
    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return the way to the goal's place where that is near, and ways to sampled waypoints.

        There are ``count`` of them; empty ones where the goal is as near as ``stop``.

        Raises:
            PersistError: when the vocabulary has no step ahead or no turn.
        """
        ahead, turns = gait(situation.info.vocabulary)
        masked = self.settings.masked or situation.goal.rgb is None
        condition = self._condition(situation, masked)
        stop = self.settings.stop
        if stop and not masked and float(self.network.distance(condition)) <= stop:
            return [()] * count
        arrival = () if masked else self._arrival(condition, ahead, turns)
        ways = [arrival[:horizon]] if arrival and leaves_free(situation, [arrival])[0] else []
        if count > len(ways):
            places = self.network.sample(condition, max(count, self.settings.samples), self.steps, generator).tolist()
            sampled = [follow_waypoints([(x, y) for x, y in way], ahead, turns, horizon) for way in places]
            free = leaves_free(situation, [way[:SOON] for way in sampled])
            order = sorted(range(len(sampled)), key=lambda number: not free[number])
            ways += [sampled[number] for number in order]
        return ways[:count]

    def _arrival(self, condition: Tensor, ahead: Action, turns: Sequence[Action]) -> tuple[str, ...]:
        """Return the straight way to where the goal's image was taken, if that is near and certain enough."""
        place, settings = self.network.goal_place(condition), self.settings
        if place is not None and place.metres <= settings.arrive and place.certainty >= settings.sure:
            return go_straight_and_face((place.ahead, place.left), place.heading, ahead, turns)
        return ()  # also where the prediction is NaN

    @torch.no_grad()
    def distance(self, situation: Situation) -> float:
        """Return how far the goal's image is, in predicted spacings of frames."""
        return float(self.network.distance(self._condition(situation, False)))

    def _condition(self, situation: Situation, masked: bool) -> Tensor:
        """What waypoints and distance follow from; a short past begins with its first frame again and again."""
        own, device = self.network.settings, next(self.network.parameters()).device
        last = len(situation.seen) - 1
        frames = [max(0, last - back * own.spacing) for back in range(own.context, -1, -1)]
        seen = situation.seen.rgb[frames]
        goal = seen[-1] if situation.goal.rgb is None else situation.goal.rgb
        hidden = torch.tensor([masked], device=device)
        condition: Tensor = self.network.condition(seen[None].to(device), goal[None].to(device), hidden)[0]
        return condition


def leaves_free(situation: Situation, ways: Sequence[tuple[str, ...]]) -> list[bool]:
    """Return for each way whether nothing on the known ground is in the way of the agent's body."""
    up = torch.tensor(situation.info.world_up, dtype=torch.float64)
    pose = situation.seen.cameras.world_from_camera[-1].cpu().double()
    poses = [torch.cat([pose[None], situation.info.vocabulary.follow(pose, way, up)]) for way in ways]
    places = [situation.ground.places(one[:, :3, 3]) for one in poses]
    starts, ends = torch.cat([one[:-1] for one in places]), torch.cat([one[1:] for one in places])
    covers = way_is_free(situation.ground, starts, ends, body_of(situation.info).radius)
    return [bool((one != Cover.OCCUPIED).all()) for one in covers.split([len(way) for way in ways])]
