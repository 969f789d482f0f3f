"""World models that draw scenes, for the parts of the benchmark that measure frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import PLAIN, find_checkpoint
from persist_cli.api.memory import Memory
from persist_cli.api.scene import Scene
from persist_cli.api.scene_model import SceneModel
from persist_cli.bench.scenes.completions import Scenes
from persist_cli.bench.scenes.scene_bench import RENDERED, RenderingPlan, SceneBench
from persist_cli.bench.scenes.views import View
from persist_cli.checkpoints.load import load_adapter
from persist_cli.checkpoints.placement import check_placement
from persist_cli.data.clips import check_size
from persist_cli.errors import PersistError
from persist_cli.evaluate.backbones import BackboneLoader
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.rollout.world_model import Agent, WorldModel

TRUE_GRID = "true grid"


@dataclass(frozen=True)
class RenderedRow:
    """An adapter with a memory whose frames are measured.

    Args:
        name: of the row.
        adapter: of the checkpoint; ``None`` for the model without one.
        true_grid: whether the scene holds the true cells of the whole house: the ceiling.
    """

    name: str
    adapter: str | None
    true_grid: bool = False


@dataclass(frozen=True)
class Renderer:
    """A row's model, ready to be used.

    Args:
        row: the row.
        backbone: with the row's adapter.
        sampling: steps, sampler and guidance.
        factory: of its memories; ``None`` without an adapter.
        model: imagines the cells of scenes; ``None`` without one.
    """

    row: RenderedRow
    backbone: Backbone
    sampling: Sampling
    factory: MemoryFactory | None
    model: SceneModel | None

    def memory(self, view: View, seed: int = 0) -> Memory | None:
        """Return the memory with which the row begins at a view: empty, or the true cells; a scene has the seed."""
        if self.factory is None:
            return None
        if not issubclass(self.factory.kind, Scene):
            return self.factory.empty(view.info).to(self.backbone.device)
        return self.scene(view, seed).to(self.backbone.device)

    def scene(self, view: View, seed: int = 0) -> Scene:
        """Return the scene with which the row begins at a view, with true cells or with the model.

        Raises:
            PersistError: when the row has no scene.
        """
        if self.factory is None:
            raise PersistError(f"row {self.row.name!r} has no memory")
        scene = Scenes(self.factory, None if self.row.true_grid else self.model).seeded(seed).empty(view.info)
        if self.row.true_grid:
            scene.add(view.house)
        return scene

    def world(self, memory: Memory | None, view: View, seed: int, body: bool, bench: SceneBench) -> WorldModel:
        """Return a world model whose agent stands at a view."""
        agent = Agent(memory, seed, body=bench.body(view) if body else None)
        world = WorldModel(self.backbone, [agent], self.sampling)
        world.reset([view.frame], [view.info])
        return world


def rendered_rows(plan: RenderingPlan) -> list[RenderedRow]:
    """Return the rows of some memories; a scene has a second one with the true cells.

    Raises:
        CheckpointError: when the checkpoint lacks an adapter.
    """
    checkpoint, rows = find_checkpoint(plan.checkpoint), []
    for name in plan.memories:
        adapter = None if name == PLAIN else name
        rows.append(RenderedRow(name, adapter))
        if adapter is not None and draws_scenes(plan, adapter):
            checkpoint.adapter_folder(adapter)
            rows.append(RenderedRow(f"{name}, {TRUE_GRID}", adapter, true_grid=True))
    return rows


def draws_scenes(plan: RenderingPlan, adapter: str) -> bool:
    """Return whether the memory of an adapter is a scene."""
    return issubclass(MemoryFactory.of_adapter(find_checkpoint(plan.checkpoint), adapter).kind, Scene)


def scene_row(rows: Sequence[RenderedRow]) -> RenderedRow:
    """Return the row of a scene with true cells.

    Raises:
        PersistError: when no memory is a scene.
    """
    for row in rows:
        if row.true_grid:
            return row
    raise PersistError("none of --memories is a scene; name the adapter that draws scenes")


class RendererLoader:
    """Loads what rows are made of, one backbone for all.

    Args:
        bench: the benchmark, whose plan has a rendering.
        plan: that rendering.
        part: of the benchmark, which decides on the sampling.
    """

    def __init__(self, bench: SceneBench, plan: RenderingPlan, part: str) -> None:
        self.bench, self.plan, self.protocol = bench, plan, RENDERED[part]
        check_placement(plan.placement)
        self.checkpoint, self.loader = find_checkpoint(plan.checkpoint), BackboneLoader(plan.placement)

    def load(self, row: RenderedRow) -> Renderer:
        """Return a row's model; the backbone has its adapter until another row is loaded.

        Raises:
            PersistError: when model and images do not go together.
        """
        backbone = self.loader.load(self.checkpoint)
        load_adapter(backbone, self.checkpoint, row.adapter)
        backbone.prepare_inference(self.plan.placement)
        check_size(self.bench.views[0].info, backbone.image_size, self.bench.plan.data)
        sampling = self.checkpoint.sampling_with(self.plan.sampling, self.protocol)
        factory = None
        if row.adapter is not None:
            factory = MemoryFactory.of_adapter(self.checkpoint, row.adapter, backbone.device)
        return Renderer(row, backbone, sampling, factory, self.bench.scenes.model)
