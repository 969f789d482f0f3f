"""``persist bench scene`` from its options to what is measured: all that is checked before, and the views."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.ground import Body
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.bench.scenes.completions import (
    CodedTruth,
    Completion,
    Empty,
    HouseSearch,
    NearestHouse,
    NearestHouses,
    Outside,
    Prior,
    SceneCompletion,
    Scenes,
    Truth,
)
from persist_cli.bench.scenes.interactions import Event, find_events
from persist_cli.bench.scenes.journal import SceneJournal
from persist_cli.bench.scenes.training_houses import House, read_houses
from persist_cli.bench.scenes.views import Region, View, near_camera, same_form, true_region
from persist_cli.checkpoints.contamination import ALLOW, OTHER_DATA, ShownScene, known_names, refuse_training_scenes
from persist_cli.checkpoints.load import checked_sampling
from persist_cli.checkpoints.scene_models import TrainedSceneModel, find_scene_model
from persist_cli.data.reference import data_folder, parse_reference
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError, PersistError, hint
from persist_cli.evaluate.provenance import adapter_json
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.memorize.memory_config import plugin_settings, scene_config
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.output.console import add_task, progress
from persist_cli.plugin_code import code_json
from persist_cli.recipe import MemoryConfig

WIDEST: Final = 50.0  # metres around a camera that are measured at most

PARTS: Final = ("completion", "walk", "return", "edits", "speed", "evolution")

# parts that need a checkpoint which draws scenes, and the protocol of evaluation for whose sampling they ask its card
RENDERED: Final = {"return": "return", "edits": ""}

EDIT_KINDS: Final = ("remove", "paint", "insert", "move", "copy")  # edit number n is of kind n modulo their count


@dataclass(frozen=True)
class RenderingPlan:
    """What draws the frames of walks and edits.

    Args:
        checkpoint: of the world model, with an adapter that draws scenes.
        memories: its adapters that are compared on walks.
        steps: frames of a walk out, and of the way back.
        sampling: in place of the checkpoint's own, which may be another one on walks.
        placement: device and precision.
    """

    checkpoint: Path
    memories: tuple[str, ...]
    steps: int
    sampling: SamplingOverrides
    placement: InferenceOptions


@dataclass(frozen=True, kw_only=True)
class SceneBenchPlan:
    """The options of ``persist bench scene``.

    Args:
        model: name or folder of a scene model; ``None`` to measure the rows that need none.
        data: test houses with cells.
        train: training houses, for the rows that look them up; ``None`` without these rows.
        parts: of ``PARTS``.
        images: most views, each of another house.
        seeds: completions of each view.
        radius: metres around the camera that are completed and measured.
        houses: most training houses that are read.
        steps: actions of a walk.
        walks: most views from which an agent walks.
        rendering: what draws the frames; ``None`` without such parts.
        edits: random edits of the part "edits".
        interactions: most interactions of the part "evolution".
        settings: texts ``memory.KEY=VALUE``.
        seed: of the choice of frames.
        allow_training_scenes: whether houses that the model was trained on may be measured.
    """

    model: str | None
    data: str
    train: str | None
    parts: tuple[str, ...]
    images: int = 32
    seeds: int = 3
    radius: float = 5.0
    houses: int = 500
    steps: int = 1000
    walks: int = 4
    rendering: RenderingPlan | None = None
    edits: int = 100
    interactions: int = 100
    settings: tuple[str, ...] = ()
    seed: int = 0
    allow_training_scenes: bool = False

    def memory(self, form: CellForm) -> MemoryConfig:
        """Return the configuration of scenes with cells of a form."""
        return scene_config(form, plugin_settings(self.settings, ("memory",))["memory"])


@dataclass(frozen=True, kw_only=True)
class SceneBench:
    """A benchmark that was checked and is ready to be run.

    Args:
        plan: the options.
        views: images that are measured.
        houses: of the training; empty without any.
        journal: keeps what was run.
        trained: the scene model; ``None`` without one.
        events: interactions of the measured houses; empty without the part "evolution".
    """

    plan: SceneBenchPlan
    views: Sequence[View]
    houses: Sequence[House]
    journal: SceneJournal
    trained: TrainedSceneModel | None = None
    events: Sequence[Event] = ()

    @cached_property
    def scenes(self) -> Scenes:
        """Scenes with the model, if there is one."""
        model = None if self.trained is None else self.trained.load()
        return Scenes(MemoryFactory.of(self.plan.memory(self.views[0].truth.form)), model)

    @property
    def rows(self) -> list[Completion]:
        """The rows of the completion; those that look training houses up only where there are any."""
        search, looked_up = HouseSearch(self.houses), list[Completion]()
        if self.houses:
            looked_up = [Prior(self.houses), NearestHouse(search), NearestHouses(search)]
        without: list[Completion] = [Empty(), Outside(), *looked_up]
        if self.scenes.model is None:
            return [*without, Truth()]
        return [SceneCompletion(self.scenes), *without, CodedTruth(self.scenes), Truth()]

    @property
    def palette(self) -> tuple[str, ...]:
        """Names of the classes of the data."""
        return self.views[0].truth.form.palette

    def body(self, view: View) -> Body:
        """Return the body of the agent in a view's house."""
        return body_of(view.info)


def prepare(plan: SceneBenchPlan, out: Path) -> SceneBench:
    """Check everything that can be checked before anything is run, and read the views.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    check_parts(plan)
    if plan.rendering is not None:
        check_samplings(plan.rendering, plan.parts)
    trained = None if plan.model is None else find_scene_model(plan.model)
    files = chosen_files(plan)
    if trained is not None:
        check_model(trained, files, plan.allow_training_scenes)
    journal = SceneJournal(out)
    views = read_views(files, plan)
    houses = training_houses(plan, views)
    events: list[Event] = []
    if "evolution" in plan.parts:
        events = find_events(plan.data, {view.scene for view in views}, plan.interactions, plan.seed)
    journal.begin(identity(plan, views), part_identities(plan, houses, trained))
    return SceneBench(plan=plan, views=views, houses=houses, journal=journal, trained=trained, events=events)


def check_samplings(plan: RenderingPlan, parts: Sequence[str]) -> None:
    """Raise ``PersistError`` when the world model cannot sample as a part asks it to, before weights are read."""
    checkpoint = find_checkpoint(plan.checkpoint)
    for part in parts:
        if part in RENDERED:
            checked_sampling(checkpoint, plan.sampling, RENDERED[part])


def check_model(trained: TrainedSceneModel, files: Sequence[TrajectoryFile], allowed: bool) -> None:
    """Raise ``PersistError`` when a model knows other cells than the data's, or was trained on one of their houses."""
    same_form(CellGrid.empty(trained.form.cells, files[0].info.world_up), files[0].cells(0).form, "the model")
    names = known_names(trained.training_scenes, trained.folder, "this model")
    if not allowed:
        refuse_training_scenes(map(ShownScene.of, files), names, f"{OTHER_DATA}, or {ALLOW}")


def check_parts(plan: SceneBenchPlan) -> None:
    """Raise ``PersistError`` when a part is unknown, or needs what is not named."""
    if not plan.parts:
        raise PersistError(f"--parts names nothing to measure; give one of {', '.join(PARTS)}")
    if not plan.radius <= WIDEST:
        raise PersistError(f"--radius {plan.radius:g}: metres, {WIDEST:g} at most")
    for part in plan.parts:
        if part not in PARTS:
            raise PersistError(f"unknown part {part!r}; {hint(part, PARTS)}")
        if part in ("walk", "speed") and plan.model is None:
            raise PersistError(f"part {part!r} needs a scene model; name one, or measure --parts completion")
        if part in RENDERED and plan.rendering is None:
            raise PersistError(f"part {part!r} needs --checkpoint, whose adapter draws scenes")


def chosen_files(plan: SceneBenchPlan) -> list[TrajectoryFile]:
    """Return the first trajectory of each house of the data, as many as are measured, evenly spread.

    Raises:
        DataError: when the folder is no data set.
    """
    by_scene: dict[str, TrajectoryFile] = {}
    for file in parse_reference(plan.data).trajectories():
        by_scene.setdefault(file.info.scene, file)
    files = list(by_scene.values())
    places = np.linspace(0, len(files) - 1, min(plan.images, len(files))).round().astype(int)
    return [files[place] for place in places]


def read_views(files: Sequence[TrajectoryFile], plan: SceneBenchPlan) -> list[View]:
    """Read a random frame of each trajectory, and write it into an empty scene.

    Raises:
        DataError: when a trajectory has no cells, or its cells are not those of the others.
    """
    scenes = Scenes(MemoryFactory.of(plan.memory(files[0].cells(0).form)), None)
    views: list[View] = []
    with progress() as bar:
        task = add_task(bar, "reading houses", len(files), "houses")
        for number, file in enumerate(files):
            frame = int(np.random.default_rng([plan.seed, number]).integers(len(file)))
            view = read_view(file, frame, plan.radius, scenes)
            same_form(view.truth, views[0].truth.form if views else view.truth.form, str(file.path))
            views.append(view)
            bar.advance(task)
    return views


def read_view(file: TrajectoryFile, frame: int, radius: float, scenes: Scenes) -> View:
    """Read one frame with the cells around it.

    Raises:
        DataError: when the trajectory has no cells.
    """
    cells = file.cells(frame)
    image = file.read([frame]).observations
    region = Region.around(cells, image.cameras.world_from_camera[0], radius)
    truth = true_region(cells, region)
    near = near_camera(truth, image.cameras.centers[0], radius)
    name, sha256 = f"{file.name}:{frame}", file.sha256
    view = View(
        name=name, scene=file.info.scene, info=file.info, frame=image, region=region, known=truth, truth=truth,
        near=near, house=cells, sha256=sha256,
    )  # fmt: skip
    known = same_form(region.of(scenes.after(view).cells), truth.form, "the scene")
    return replace(view, known=known)


def training_houses(plan: SceneBenchPlan, views: Sequence[View]) -> list[House]:
    """Read the training houses.

    Raises:
        DataError: when one of them is measured, too.
    """
    if plan.train is None or "completion" not in plan.parts:
        return []
    measured = {view.scene for view in views}
    store = Store(data_folder(plan.train))
    both = sorted({file.info.scene for file in store} & measured)
    if both:
        raise DataError(
            f"{plan.train}: scene {both[0]!r} is measured, too; name training data without the test's houses"
        )
    return read_houses(store, plan.houses, views[0].truth.form)


def identity(plan: SceneBenchPlan, views: Sequence[View]) -> dict[str, Any]:
    """Return JSON values of all that changes the figures of every part."""
    values: Mapping[str, Any] = {
        "views": digest([f"{view.scene} {view.name} {view.sha256}" for view in views]),
        "memory": asdict(plan.memory(views[0].truth.form)),
        "radius": plan.radius,
    }
    return dict(json.loads(json.dumps(values, default=str)))


def part_identities(
    plan: SceneBenchPlan, houses: Sequence[House], trained: TrainedSceneModel | None
) -> dict[str, dict[str, Any]]:
    """Return by part, and by row of the completion, JSON values of all that changes its figures beside ``identity``.

    The numbers of seeds, walks, edits and interactions may change: what is there is kept.
    """
    model: dict[str, Any] = {"model": None if trained is None else trained.fingerprint}
    if trained is not None:
        model |= code_json(("scene model", trained.plugin))
    parts: dict[str, dict[str, Any]] = {"walk": model | {"steps": plan.steps}, "speed": model}
    if plan.rendering is not None:
        rendering = {part: rendering_identity(plan.rendering, protocol) for part, protocol in RENDERED.items()}
        parts["return"] = model | rendering["return"] | {"steps": plan.rendering.steps}
        parts["edits"] = rendering["edits"] | {"seed": plan.seed, "kinds": EDIT_KINDS}
    found = {name: values for name, values in parts.items() if name in plan.parts}
    if plan.rendering is not None and RENDERED.keys() & found.keys():
        found |= adapter_identities(plan.rendering)
    if "completion" in plan.parts:
        looked_up = {"training houses": digest([f"{house.scene} {house.sha256}" for house in houses])}
        found |= {} if trained is None else {SceneCompletion.name: model}
        found |= {row.name: looked_up for row in (Prior, NearestHouse, NearestHouses) if houses}
    if "evolution" in plan.parts and trained is not None:
        compared = model | {"compared with": "the cells as the codec holds them"}
        found |= {f"evolution {name}": compared for name in ("model", "model, not told")}
    return dict(json.loads(json.dumps(found, default=str)))


def digest(names: Sequence[str]) -> str:
    """Return how many names there are, with the beginning of a hash of all."""
    return f"{len(names)}, hash {hashlib.sha256(json.dumps(list(names)).encode()).hexdigest()[:12]}"


def rendering_identity(plan: RenderingPlan, protocol: str) -> dict[str, Any]:
    """Return JSON values of what draws the frames, but for the adapters; memories may be added."""
    checkpoint = find_checkpoint(plan.checkpoint)
    sampling = asdict(checkpoint.sampling_with(plan.sampling, protocol)) | plan.placement.changes()
    code = code_json(("backbone", checkpoint.backbone))
    return {"checkpoint": checkpoint.fingerprint, "sampling": sampling, **code}


def adapter_identities(plan: RenderingPlan) -> dict[str, dict[str, Any]]:
    """Return for each adapter that draws frames the hashes of its weights and settings."""
    folders = find_checkpoint(plan.checkpoint).adapters
    return {f"adapter {name}": adapter_json(folders[name]) for name in plan.memories if name in folders}
