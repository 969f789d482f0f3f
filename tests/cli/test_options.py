"""What is said on the command line reaches the plan of the command's work, each option the field that it is for."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import pytest

from persist_cli.api.inference import SamplingOverrides
from persist_cli.evaluate.new_poses import NewPoses
from persist_cli.play.sessions import Limits

COLLECT = "collect miniworld --out out --scenes 0:1", "simulators.collect.run_collect"
IMPORT = "import 7scenes captures --out out", "data.importers.importing.run_import"
FINETUNE = "finetune tiny-codec", "train.finetune.run_finetune"
EXPORT = "export runs/stage1 --out out", "checkpoints.export.run_export"
MEMORIZE = "memorize walks", "memorize.build.run_memorize"
ROLLOUT = "rollout --start walks#0:0 --out out", "rollout.rollout.run_rollout"
EVAL = "eval reference", "evaluate.evaluate.run_eval"
PLAN = "plan --start walks#0:0 --goal walks#0:3 --out out", "planning.plan.run_plan"
LEARN = "learn --views walks#0 --out out", "learn.learn.run_learn"
EPISODES = "bench episodes", "episodes.make_episodes.run_episodes"
COLLISIONS = "bench collisions", "bench.collisions.run_collisions"
BENCH_PLAN = "bench plan", "bench.plans.run_plan_bench.run_plan_bench"
BENCH_SCENE = "bench scene --data houses --parts evolution", "bench.scenes.run_scene_bench.run_scene_bench"
PLAY = "play", "play.serve.run_play"
EDIT = "edit scene.safetensors --out edited.safetensors", "editing.edit.run_edit"
VIEW = "view scene.safetensors", "viewer.view.run_view"


@pytest.mark.parametrize(
    ("command", "option", "field", "value"),
    [
        (COLLECT, "--light 0.6:1.2", "light", "0.6:1.2"), (COLLECT, "--tint 0.15", "tint", "0.15"),
        (COLLECT, "--depth-sensor kinect", "depth_sensor", "kinect"), (COLLECT, "--fov 45:90", "fov", "45:90"),
        (COLLECT, "--height 0.6:1.7", "height", "0.6:1.7"), (COLLECT, "--pitch -25:10", "pitch", "-25:10"),
        (COLLECT, "--frames 7", "frames", 7), (COLLECT, "--seed 7", "seed", 7), (COLLECT, "--turn 5", "turn", "5"),
        (COLLECT, "--step 0.1", "step", "0.1"), (COLLECT, "--split test", "split", "test"),
        (COLLECT, "--set radius=0.15 --set data.path=here", "settings", {"radius": 0.15, "data": {"path": "here"}}),
        (COLLISIONS, "--set radius=0.15", "scenes.settings", {"radius": 0.15}),
        (IMPORT, "--every 3", "every", 3), (IMPORT, "--step 0.1", "step", 0.1), (IMPORT, "--turn 5", "turn", 5),
        (IMPORT, "--skip-bad", "skip_bad", True), (IMPORT, "--hold-out 0.2", "hold_out", 0.2),
        (IMPORT, "--size 32x48", "size", (32, 48)), (IMPORT, "--up 0,-2,0", "up", (0, -1, 0)),
        (FINETUNE, "--resume", "resume", True), (FINETUNE, "--profile", "profile", True),
        (EXPORT, "--dtype float32", "dtype", "float32"), (EXPORT, "--default voxel", "default", "voxel"),
        (EXPORT, "--context-noise 0.5", "sampling", SamplingOverrides(context_noise=0.5)),
        (EXPORT, "--autoguidance 2", "sampling", SamplingOverrides(autoguidance=2)),
        (MEMORIZE, "--encoder dino", "encoder", "dino"), (MEMORIZE, "--complete", "complete", True),
        (MEMORIZE, "--fov 60", "fov", 60), (MEMORIZE, "--depth-model there", "depth_model", "there"),
        (ROLLOUT, "--no-write", "world.write", False), (ROLLOUT, "--no-body", "world.body", False),
        (ROLLOUT, "--follow", "follow", True), (ROLLOUT, "--seed 7", "world.seed", 7),
        (ROLLOUT, "--turn 5", "turn", 5), (ROLLOUT, "--step 0.1", "step", 0.1), (ROLLOUT, "--frames 7", "frames", 7),
        (ROLLOUT, "--context-noise 0.5", "world.sampling", SamplingOverrides(context_noise=0.5)),
        (ROLLOUT, "--autoguidance 2", "world.sampling", SamplingOverrides(autoguidance=2)),
        (ROLLOUT, "--dtype bfloat16", "world.placement.dtype", "bfloat16"),
        (EVAL, "--resample clips", "resample", "clips"), (EVAL, "--training-seeds", "training_seeds", True),
        (EVAL, "--allow-training-scenes", "allow_training_scenes", True), (EVAL, "--clips 7", "clips", 7),
        (EVAL, "--frames 7", "frames", 7), (EVAL, "--seeds 7", "seeds", 7), (EVAL, "--batch 7", "batch", 7),
        (EVAL, "--pose-noise 7 8", "noise", (7, 8)), (EVAL, "--new-poses 7 8", "new_poses", NewPoses(7, 8)),
        (EVAL, "--context-noise 0.5", "sampling", SamplingOverrides(context_noise=0.5)),
        (EVAL, "--autoguidance 2", "sampling", SamplingOverrides(autoguidance=2)),
        (PLAN, "--candidates 7", "candidates", 7), (PLAN, "--rounds 7", "rounds", 7), (PLAN, "--seed 7", "seed", 7),
        (PLAN, "--frames 7", "frames", 7), (PLAN, "--seconds 7", "seconds", 7), (PLAN, "--batch 7", "batch", 7),
        (PLAN, "--over best", "over", "best"), (PLAN, "--horizon 7", "horizon", 7), (PLAN, "--step 0.1", "step", 0.1),
        (PLAN, "--context-noise 0.5", "sampling", SamplingOverrides(1, None, 1.0, 0.5, 1.0)),
        (LEARN, "--walks 7", "practice.walks", 7), (LEARN, "--actions 7", "practice.actions", 7),
        (LEARN, "--execute 7", "practice.execute", 7), (LEARN, "--proposals 7", "practice.proposals", 7),
        (LEARN, "--explore 0.7", "practice.explore", 0.7), (LEARN, "--training-steps 7", "steps", 7),
        (LEARN, "--batch 7", "practice.batch", 7), (LEARN, "--rounds 7", "rounds", 7), (LEARN, "--seed 7", "seed", 7),
        (LEARN, "--episodes e.json --patience 7", "loop.patience", 7),
        (LEARN, "--episodes e.json --stop-cost 0.7", "stop_cost", 0.7),
        (LEARN, "--context-noise 0.5", "sampling", SamplingOverrides(context_noise=0.5)),
        (EPISODES, "--each 7", "each", 7), (EPISODES, "--walk-frames 7", "walk_frames", 7),
        (EPISODES, "--step 0.5", "step", "0.5"), (EPISODES, "--turn 30", "turn", "30.0"),
        (EPISODES, "--fov 60", "fov", "60.0"), (EPISODES, "--height 1", "height", "1.0"),
        (EPISODES, "--pitch -10", "pitch", "-10.0"), (EPISODES, "--set radius=0.15", "settings", {"radius": 0.15}),
        (EPISODES, "--per-scene 7", "per_scene", 7), (EPISODES, "--goal-gap 7", "goal_gap", 7),
        (COLLISIONS, "--walks 7", "walks", 7), (COLLISIONS, "--actions 7", "actions", 7),
        (COLLISIONS, "--seed 7", "scenes.seed", 7), (COLLISIONS, "--split train", "scenes.split", "train"),
        (COLLISIONS, "--context-noise 0.5", "sampling", SamplingOverrides(context_noise=0.5)),
        (BENCH_PLAN, "--no-approach", "planning.approach", False), (BENCH_PLAN, "--no-keep", "planning.keep", False),
        (BENCH_PLAN, "--no-explore", "planning.explore", False), (BENCH_PLAN, "--no-body", "planning.body", False),
        (BENCH_PLAN, "--horizon 7", "planning.horizon", 7), (BENCH_PLAN, "--execute 7", "loop.execute", 7),
        (BENCH_PLAN, "--patience 7", "loop.patience", 7), (BENCH_PLAN, "--max-actions 7", "loop.max_actions", 7),
        (BENCH_PLAN, "--guidance 2", "sampling", SamplingOverrides(memory_guidance=2)),
        (BENCH_PLAN, "--over best", "planning.over", "best"), (BENCH_PLAN, "--stop-cost 0.7", "stop_cost", 0.7),
        (BENCH_PLAN, "--frames 7", "planning.frames", 7), (BENCH_PLAN, "--seconds 7", "planning.seconds", 7),
        (BENCH_SCENE, "--interactions 7", "interactions", 7), (BENCH_SCENE, "--images 7", "images", 7),
        (BENCH_SCENE, "--seeds 7", "seeds", 7), (BENCH_SCENE, "--radius 7", "radius", 7),
        (BENCH_SCENE, "--seed 7", "seed", 7), (BENCH_SCENE, "--set memory.a=1", "settings", ("memory.a=1",)),
        (PLAY, "--no-open", "browser", False), (PLAY, "--json --open", "browser", True), (PLAY, "--port 7", "port", 7),
        (PLAY, "--no-ahead", "settings.ahead", False), (PLAY, "--no-body", "begin.body", False),
        (PLAY, "--guidance 2", "settings.guidance", 2), (PLAY, "--autoguidance 2", "settings.autoguidance", 2),
        (PLAY, "--seed 7", "settings.seed", 7), (PLAY, "--clip-frames 5", "settings.clip_frames", 5),
        (PLAY, "--fps 7", "limits", Limits(4, 7)), (PLAY, "--sessions 7", "limits", Limits(7, 15)),
        (EDIT, "--overwrite", "overwrite", True), (EDIT, "--seed 7", "seed", 7),
        (VIEW, "--no-open", "opens", False), (VIEW, "--most 700", "most", 700), (VIEW, "--seed 7", "imagine.seed", 7),
        (VIEW, "--port 7", "port", 7), (VIEW, "--adapter voxel", "imagine.adapter", "voxel"),
    ],
)  # fmt: skip
def test_an_option_reaches_the_plan_of_its_command(persist, monkeypatch, command, option, field, value):
    line, work = command
    given: list[Any] = []
    monkeypatch.setattr(f"persist_cli.{work}", lambda *arguments: given.extend(arguments))
    ended = persist(*line.split(), *option.split())
    assert (ended.code, ended.err) == (0, "")
    [plan] = [argument for argument in given if hasattr(argument, field.partition(".")[0])]
    assert attrgetter(field)(plan) == value
