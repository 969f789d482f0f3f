"""``persist learn``: a policy practises in a new house inside the model, learns from what it reached, and repeats.

A round practises, adds its walks to those of the rounds before, fine-tunes the policy on all of them, and evaluates it
in the true scene. What is done is not done again, so a stopped run goes on: it repeats at most a batch of walks, what
was trained since the last checkpoint, and an episode.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from persist_cli.api.checkpoint import PLAIN, Checkpoint, find_checkpoint, step_folders
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.checkpoints.contamination import refuse_training_episodes
from persist_cli.checkpoints.placement import check_placement
from persist_cli.checkpoints.retention import ended_recipe
from persist_cli.data.store import write_trajectory
from persist_cli.episodes.episodes import Episode
from persist_cli.episodes.run_episode import LoopSettings
from persist_cli.errors import DataError, PersistError
from persist_cli.evaluate.provenance import adapter_plugins
from persist_cli.io.begun_with import check_same
from persist_cli.io.exclusive import exclusive
from persist_cli.io.files import check_folder, file_sha256, read_json, write_json, write_text
from persist_cli.learn.evaluation import STOP_COST, episodes_of, evaluate_policy, mean_figures, stop_rule
from persist_cli.learn.places import ImaginedPlace, PracticePlace, TruePlace
from persist_cli.learn.practice import PracticeSettings, info_of_walks, practise
from persist_cli.memorize.sources import common_reference, find_sources
from persist_cli.output.console import add_task, print_json, print_table, progress, say
from persist_cli.output.curve import Curve, draw_curves
from persist_cli.planning.true_futures import open_again
from persist_cli.plugin_code import code_json
from persist_cli.plugins import make_policy, make_settings
from persist_cli.policies.open_policy import acting_settings, open_trained
from persist_cli.policies.trained import TrainedPolicy, find_policy, packaged_policy
from persist_cli.recipe import apply_overrides, make_recipe
from persist_cli.rollout.open_world import WorldOptions, assemble_world
from persist_cli.train.finetune import FinetunePlan, run_finetune
from persist_cli.train.sources import weights_hash

PLAN: Final = "plan.json"
WALKS: Final = "walks.json"  # of a round: how many walks are done, and their counts
RESULTS: Final = "learn.json"
CURVE: Final = "success.png"
FIGURES: Final = ("success", "reached", "spl", "soft_spl", "collisions_per_action", "end_metres")
DETOUR: Final = 2.0  # times the direct way; what a walk came to by a longer one is no goal in hindsight
MODEL, SIMULATOR = "model", "simulator"  # where a policy may practise
LOOK: Final = ("light", "gains", "depth_sensor")  # of a collecting camera, which the true house has not


@dataclass(frozen=True, kw_only=True)
class LearnPlan:
    """The options of ``persist learn``.

    Args:
        views: references to the given posed frames of one scene.
        policy: run or folder of the trained policy to begin with; ``None`` for the package's.
        inside: ``model``, or ``simulator`` for the true scene.
        checkpoint: of the world model.
        adapter: its memory adapter; ``None`` for the default, ``stage1`` for none.
        rounds: of practice and fine-tuning.
        practice: of each round.
        steps: training steps of each round.
        training: other settings of the training, as in ``training.learning_rate=1e-4``.
        episodes: file of episodes, of which those in the scene of the views are run; ``None`` evaluates nothing.
        loop: how they are run.
        sampling: of the world model.
        seed: of all that is random.
        placement: precision and memory savings of the world model.
        stop_cost: LPIPS of view and goal image up to which the evaluated agent stops; at 0 only its policy stops it.
        body: whether walls stop the agent inside the model; ``None``: where the height of its camera is told, see
            ``tells_body``.
        allow_training_scenes: whether a scene that model or policy was trained on may be evaluated.
    """

    views: tuple[str, ...]
    policy: str | None
    inside: str
    checkpoint: Path
    adapter: str | None
    rounds: int
    practice: PracticeSettings
    steps: int
    training: tuple[str, ...]
    episodes: Path | None
    loop: LoopSettings
    sampling: SamplingOverrides
    seed: int
    placement: InferenceOptions = field(default_factory=InferenceOptions)
    stop_cost: float = STOP_COST
    body: bool | None = None
    allow_training_scenes: bool = False


@dataclass(frozen=True, kw_only=True)
class Learning:
    """A plan that was checked, with all that a round needs.

    Args:
        plan: the options.
        out: the folder of all results.
        info: scene, up axis and vocabulary of the views.
        views: the given posed frames.
        begin: the policy to begin with.
        simulator: of the scene, for practice or evaluation; ``None`` where neither needs it.
        episodes: to evaluate with.
    """

    plan: LearnPlan
    out: Path
    info: TrajectoryInfo
    views: Observations
    begin: TrainedPolicy
    simulator: Simulator | None
    episodes: Sequence[Episode]

    def folder(self, number: int) -> Path:
        """Return the folder of a round, counted from 1; that of 0 holds the figures of the policy to begin with."""
        return self.out / f"round-{number:02d}"

    def policy(self, number: int) -> TrainedPolicy:
        """Return the policy after a round, or the one to begin with after round 0."""
        return find_policy(self.folder(number) / "policy") if number else self.begin


def run_learn(plan: LearnPlan, out: Path, as_json: bool) -> None:
    """Run all rounds that are not done yet, and leave ``learn.json``, ``success.png`` and the last policy.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    check_folder(out)
    with exclusive(out):
        learning = prepare(plan, out)
        # the lines of each training are no part of the JSON
        with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
            run_rounds(learning)
        results = summary(learning)
        write_json(out / RESULTS, results)
        if learning.episodes:
            draw_curves(success_curves(results), "actions of practice", "share of episodes", out / CURVE, False)
        report(learning, results, as_json)


def run_rounds(learning: Learning) -> None:
    """Run all rounds that are not done yet."""
    rounds = range(1, learning.plan.rounds + 1)
    walked = {number for number in rounds if counts_of(learning, number)["walks"] == learning.plan.practice.walks}
    place = None if len(walked) == len(rounds) else open_place(learning)  # whatever does not fit there ends it here
    keep_plan(learning)
    evaluate(learning, 0)
    for number in rounds:
        if place is not None and number not in walked:
            walk(learning, place, number)
        train(learning, number)
        evaluate(learning, number)


def prepare(plan: LearnPlan, out: Path) -> Learning:
    """Check everything that can be checked before the model is loaded, and write nothing."""
    check_placement(plan.placement)  # a missing accelerator is an error before anything is loaded
    if plan.inside not in (MODEL, SIMULATOR):
        raise PersistError(f"--inside {plan.inside!r}: a policy practises inside the {MODEL} or the {SIMULATOR}")
    if not 0 <= plan.stop_cost < math.inf:
        raise PersistError(f"--stop-cost {plan.stop_cost:g}: give a finite number of at least 0")
    if plan.inside == SIMULATOR and plan.body is False:
        raise PersistError("--no-body: nobody goes through walls of the true house; leave out --inside simulator")
    begin = packaged_policy() if plan.policy is None else find_policy(Path(plan.policy))
    sources = find_sources(list(plan.views))
    common_reference(sources)
    info = sources[0].file.info
    views = Observations.concatenate([source.file.read(list(source.frames)).observations for source in sources])
    simulator = None if plan.episodes is None and plan.inside == MODEL else open_simulator(plan, info)
    episodes = [] if plan.episodes is None or simulator is None else episodes_of(plan.episodes, info, simulator)
    if episodes:
        stop_rule(plan.stop_cost)  # weights that are missing are an error before anything is done
        check_held_out(plan, begin, info.scene)
    check_horizon(plan, begin)
    check_training(plan, begin)
    learning = Learning(plan=plan, out=out, info=info, views=views, begin=begin, simulator=simulator, episodes=episodes)
    check_plan(learning)
    return learning


def check_training(plan: LearnPlan, begin: TrainedPolicy) -> None:
    """Raise ``PersistError`` when the settings of the training are none, or change what is trained."""
    for text in plan.training:
        if not text.startswith(("training.", "data.")):
            raise PersistError(f"--set {text}: a round keeps its policy; set training.* and data.* alone")
    make_recipe(apply_overrides(recipe_of_round(plan, begin, 1), plan.training), "--set")


def identity(learning: Learning) -> dict[str, Any]:
    """Return JSON values of all that changes what is learned: a learning with equal values goes on."""
    plan, begin = learning.plan, learning.begin
    acts = acting_settings(make_settings("policy", begin.plugin, {}))
    values = asdict(plan) | {
        "policy": {"fingerprint": begin.fingerprint, "settings": acts},
        "checkpoint": None, "episodes": None, "rounds": None,
        "views": {"path": plan.views, "fingerprint": digest(learning.views)},
        "sampling": asdict(plan.sampling) | plan.placement.changes(),
        "ground": "of the given views and the walk",  # by which proposals are judged; once that of the memory
    }  # fmt: skip
    del values["placement"], values["allow_training_scenes"]  # neither changes what is learned
    if plan.inside == MODEL:
        values |= model_identity(plan)
    if plan.episodes is not None:
        values["episodes"] = file_sha256(plan.episodes)
    values |= code_json(*plugins_of(learning))
    return dict(json.loads(json.dumps(values, default=str)))


def chosen_model(plan: LearnPlan) -> tuple[Checkpoint, str | None]:
    """Return the checkpoint inside which the policy practises, and its chosen adapter; ``None`` is for none."""
    checkpoint = find_checkpoint(plan.checkpoint)
    return checkpoint, checkpoint.chosen_adapter(plan.adapter)


def model_identity(plan: LearnPlan) -> dict[str, Any]:
    """Return JSON values that tell models, and the adapters that are chosen of them, apart."""
    checkpoint, adapter = chosen_model(plan)
    weights = weights_hash(checkpoint, adapter)
    return {"checkpoint": checkpoint.fingerprint, "adapter": {"name": adapter or PLAIN, "sha256": weights}}


def plugins_of(learning: Learning) -> list[tuple[str, str]]:
    """Return the plugins that act, imagine or show the true scene, by kind and name."""
    plan, plugins = learning.plan, [("policy", learning.begin.plugin)]
    if learning.simulator is not None:
        plugins.append(("simulator", learning.simulator.name))
    if plan.inside == MODEL:
        checkpoint, adapter = chosen_model(plan)
        plugins.append(("backbone", checkpoint.backbone))
        if adapter is not None:
            plugins += adapter_plugins(checkpoint.adapter_folder(adapter))
    return plugins


def digest(views: Observations) -> str:
    """Return a hash of frames and poses."""
    tensors = (views.rgb, views.depth, views.cameras.world_from_camera)
    return hashlib.sha256(b"".join(tensor.contiguous().numpy().tobytes() for tensor in tensors)).hexdigest()


def check_plan(learning: Learning) -> None:
    """Raise ``PersistError`` when the folder holds another learning."""
    file = learning.out / PLAN
    if file.is_file():
        check_same(read_json(file), identity(learning), f"{learning.out}: holds another learning")


def keep_plan(learning: Learning) -> None:
    """Write down what is learned, unless that is done."""
    if not (learning.out / PLAN).is_file():
        learning.out.mkdir(parents=True, exist_ok=True)
        write_json(learning.out / PLAN, identity(learning))


def check_horizon(plan: LearnPlan, begin: TrainedPolicy) -> None:
    """Raise ``PersistError`` when walks are too short for a sample of the policy's training."""
    form = begin.load().sample_form
    needed = form.waypoints * form.spacing
    if plan.practice.actions < needed:
        raise PersistError(
            f"walks of {plan.practice.actions} actions: the policy learns from {needed} actions at once, and blocked "
            f"ones do not count; give --actions {2 * needed} or more"
        )


def check_held_out(plan: LearnPlan, begin: TrainedPolicy, scene: str) -> None:
    """Raise ``DataError`` when model or policy were trained on the evaluated scene, unless that is allowed."""
    checkpoint = find_checkpoint(plan.checkpoint) if plan.inside == MODEL else None
    refuse_training_episodes([scene], checkpoint, begin, plan.allow_training_scenes)


def open_simulator(plan: LearnPlan, info: TrajectoryInfo) -> Simulator:
    """Return the simulator of the views with their scene open."""
    simulator = open_again(info)
    if simulator is None:
        raise DataError(f"{' '.join(plan.views)}: of no simulator; leave --episodes and --inside {SIMULATOR} out")
    look = [name for name in LOOK if name in info.source.get("camera", {})]
    if look:
        raise DataError(
            f"{' '.join(plan.views)}: collected with {' and '.join(look)} of their own, which the true house has "
            f"not; leave --episodes and --inside {SIMULATOR} out"
        )
    return simulator


def open_place(learning: Learning) -> PracticePlace:
    """Return where the policy practises."""
    plan, info = learning.plan, learning.info
    if plan.inside == SIMULATOR:
        assert learning.simulator is not None
        return TruePlace(learning.simulator, info)
    checkpoint, adapter = chosen_model(plan)
    options = WorldOptions(
        start=plan.views[0], adapter=plan.adapter, seed=plan.seed, sampling=plan.sampling, placement=plan.placement,
        body=plan.body,
    )  # fmt: skip
    world = assemble_world(checkpoint, adapter, options, info)
    world.agents[0].memorize(learning.views, world.backbone.device)
    origin = {"model": checkpoint.fingerprint, "adapter": adapter or PLAIN}
    return ImaginedPlace(world, info, origin)


def counts_of(learning: Learning, number: int) -> dict[str, int]:
    """Return how many walks of a round are done, with their actions, blocked actions and goals."""
    file = learning.folder(number) / WALKS
    return dict(read_json(file)) if file.is_file() else dict.fromkeys(("walks", "actions", "blocked", "goals"), 0)


def walk(learning: Learning, place: PracticePlace, number: int) -> None:
    """Practise with the policy of the round before, and write its walks as a data set; batches that are done count."""
    trained = learning.policy(number - 1)
    policies = open_trained(trained), make_policy("random", {})
    settings, folder = learning.plan.practice, learning.folder(number) / "walks"
    seed, counts = learning.plan.seed * 1000 + number, counts_of(learning, number)
    info = info_of_walks(learning.info, place)
    folder.mkdir(parents=True, exist_ok=True)
    with progress() as bar:
        task = add_task(bar, f"round {number}: practising", settings.walks, "walks", done=counts["walks"])
        for one in practise(place, policies, learning.views, settings, seed, counts["walks"]):
            write_trajectory(folder / f"walk-{counts['walks']:05d}.parquet", info, one.frames())
            more = {"walks": 1, "actions": len(one.actions), "blocked": one.blocked, "goals": one.goals}
            counts = {name: counts[name] + value for name, value in more.items()}
            if counts["walks"] % settings.batch == 0 or counts["walks"] == settings.walks:
                write_json(learning.folder(number) / WALKS, counts)
            bar.advance(task)


def recipe_of_round(plan: LearnPlan, before: TrainedPolicy, number: int) -> dict[str, Any]:
    """Return the plain values of the recipe by which the policy of the round before is fine-tuned."""
    return {
        "stage": "policy", "description": f"round {number} of a policy that practises", "base": str(before.folder),
        "policy": {"name": before.plugin, "settings": before.settings}, "data": {"detour": DETOUR},
        "training": {"steps": plan.steps, "seed": plan.seed, "precision": "no", "learning_rate": 1e-4, "warmup": 20,
                     "batch": 64, "ema": 0.99},
    }  # fmt: skip


def train(learning: Learning, number: int) -> None:
    """Fine-tune the policy of the round before on the walks of all rounds so far, unless that is done."""
    run, plan = learning.folder(number) / "policy", learning.plan
    steps = step_folders(run)
    if steps and ended_recipe(steps[-1]):
        return
    recipe = recipe_of_round(plan, learning.policy(number - 1), number)
    file = learning.folder(number) / "policy.yaml"
    if not file.is_file():
        write_text(file, yaml.safe_dump(recipe, sort_keys=False))
    data = [str(learning.folder(one) / "walks") for one in range(1, number + 1)]
    run_finetune(FinetunePlan(recipe=str(file), overrides=plan.training, data=data, out=run, resume=True))


def evaluate(learning: Learning, number: int) -> None:
    """Run the episodes with the policy after a round that are not done yet.

    An older persist measured SoftSPL otherwise and kept no metres of the start: then they are run again.
    """
    file = learning.folder(number) / "episodes.json"
    kept = read_json(file) if file.is_file() else {}
    if not learning.episodes or "start_metres" in kept.get("figures", ()):
        return
    assert learning.simulator is not None
    policy, stop = open_trained(learning.policy(number)), stop_rule(learning.plan.stop_cost)
    records = [] if "figures" in kept else kept.get("episodes", [])
    rest = learning.episodes[len(records) :]
    for record in evaluate_policy(policy, learning.simulator, rest, stop, learning.plan.loop):
        records.append(record)
        write_json(file, {"episodes": records})
    write_json(file, {"figures": mean_figures(records), "episodes": records})


def summary(learning: Learning) -> dict[str, Any]:
    """Return what was learned as JSON values, a row for each round and one before them."""
    rows: list[dict[str, Any]] = []
    walked = 0
    for number in range(learning.plan.rounds + 1):
        folder = learning.folder(number)
        row: dict[str, Any] = {"round": number}
        if number:
            row["practice"] = read_json(folder / WALKS)
            walked += row["practice"]["actions"] + row["practice"]["blocked"]
        if learning.episodes:
            row["figures"] = read_json(folder / "episodes.json")["figures"]
        rows.append(row | {"walked": walked, "policy": str(learning.policy(number).folder)})
    return {
        "format": "persist-learning", "version": 1, "inside": learning.plan.inside, "scene": learning.info.scene,
        "views": len(learning.views), "episodes": len(learning.episodes), "rounds": rows,
        "allow_training_scenes": learning.plan.allow_training_scenes,
    }  # fmt: skip


def success_curves(results: dict[str, Any]) -> list[Curve]:
    """Return the curves of success, and of how often the goal was reached at all, over the actions of practice."""
    rows = results["rounds"]
    return [
        Curve(name, [(row["walked"], row["figures"][name], None, None) for row in rows])
        for name in ("success", "reached")
    ]


def report(learning: Learning, results: dict[str, Any], as_json: bool) -> None:
    """Print the rounds as a table, or the results as JSON."""
    if as_json:
        print_json(results)
        return
    columns = ["round", "actions of practice", "blocked", *(FIGURES if learning.episodes else ())]
    rows = []
    for row in results["rounds"]:
        means = [row["figures"][name] for name in FIGURES] if learning.episodes else []
        figures = ["–" if mean is None or math.isnan(mean) else f"{mean:.2f}" for mean in means]
        blocked = str(row["practice"]["blocked"]) if row["round"] else "–"
        rows.append([str(row["round"]), str(row["walked"]), blocked, *figures])
    print_table(
        f"learned inside the {results['inside']}, {results['views']} views of {results['scene']}", columns, rows
    )
    if learning.episodes:
        say(f"{results['episodes']} episodes in the true scene; curves: {learning.out / CURVE}")
    say(f"the last policy: {results['rounds'][-1]['policy']}; all figures: {learning.out / RESULTS}")
