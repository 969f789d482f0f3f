"""What can be set of the memory ``scene``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveInt

from persist_cli.api.cells import COMMON
from persist_memory.metres import Metres

MOST_CELLS = 10_000_000  # of the box: some 500 MB, and at 0.25 m a house of 200 m by 200 m with four floors

Distance = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Height = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True)
class GridSceneSettings:
    """The cells of a scene, how they are read, and what imagines the unknown ones.

    Args:
        size: edge of a cell in metres.
        palette: names of the classes, the first three free, solid and outside; a scene model has its own.
        floor: height of the floor in metres along up. The windows of a scene model begin there.
        farthest: metres of depth beyond which what frames show is not believed.
        layers: surfaces along each ray that a read returns, one behind the other.
        stride: pixels from ray to ray of a read; it is larger where the first surfaces are more than the budget.
        unknown: whether rays of a read go through cells of which nothing is known, or end there.
        writes_imagined: whether frames that a video model imagined fill unknown cells; they are renderings of the
            scene, so by default it takes nothing from them.
        model: folder of the scene model that imagines unknown cells; none without one.
        steps: denoising steps of the scene model.
        seed: seed of what is imagined while an agent walks.
        foresight: metres of depth up to which what an agent will see is imagined before it looks.
        evolution: whether things are picked up, dropped and toggled by rules, or as the scene model says.
        carries: metres along each axis of the largest thing that can be picked up.
        toggles: classes of the things whose colour toggling turns into its complement; walls and doors are no things.
    """

    size: Metres = 0.25
    palette: tuple[str, ...] = COMMON
    floor: Height = 0.0
    farthest: Metres = 10.0
    layers: PositiveInt = 2
    stride: PositiveInt = 1
    unknown: Literal["clear", "ends"] = "clear"
    writes_imagined: bool = False
    model: str | None = None
    steps: PositiveInt = 30
    seed: NonNegativeInt = 0
    foresight: Distance = 5.0
    evolution: Literal["rules", "model"] = "rules"
    carries: Metres = 0.75
    toggles: tuple[str, ...] = ("solid", "box")

    def __post_init__(self) -> None:
        if self.palette[: len(COMMON)] != COMMON or len(set(self.palette)) < len(self.palette):
            raise ValueError(f"palette must begin with {', '.join(COMMON)} and name no class twice")
        if len(self.palette) > 256:
            raise ValueError(f"palette has {len(self.palette)} classes; a cell can have 256")
