"""``make scenes``: a model of scenes and its renderer from nothing to their figures, by commands of a user.

``python -m persist_cli.reproduce.scenes [OUT]`` runs them in order, each in a process of its own. Every command
continues where it was stopped and repeats nothing that is done, so this may be stopped and started at any time. With
``--trial`` each command runs in its smallest form, to see in minutes that all of them work here; its figures are worth
nothing.

- Houses are collected with their cells: to train on, and of the test split, walks as well as interactions.
- The three stages of a model of scenes and the renderer are trained, this on true cells first, then on imagined ones.
  With ``--scene-model`` and ``--renderer`` trained ones are measured, and nothing is trained in their place.
- Completions of one image, walks of 1,000 steps, the cost, edits and interactions follow; then ways there and back, of
  the memories of the packaged model and of the renderer, and one of 1,000 frames.
- At last agents learn in scenes and in maps of one image, and in the true houses.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import REFERENCE
from persist_cli.checkpoints.scene_models import find_scene_model
from persist_cli.reproduce import scene_agents
from persist_cli.reproduce.commands import COLLECT, run_line, run_main
from persist_cli.reproduce.plan_file import keep_plan, model_json
from persist_cli.reproduce.trial import run_small, trial_folder

WEIGHTS: Final = ("lpips-alex", "i3d-kinetics-400")

HOUSES: Final = {"path": "0:3100 --frames 24", "interact": "3100:3600 --frames 48"}  # to train on, by policy

HELD_OUT: Final = {"path": "0:40 --frames 129", "interact": "40:80 --frames 96"}

TRAINED: Final = "training.schedule=constant training.cooldown=1000"  # so that more --steps could follow

MEMORIES: Final = "scene,voxel,map2d,snapshots,none"  # of the packaged model

SEEDS: Final = 3

SMALL_AGENTS: Final = "--houses 1 --seeds 1 --steps 16 --envs 2 --episodes 2"  # of a trial


@dataclass(frozen=True)
class SceneFigures:
    """What is trained and measured.

    Args:
        out: folder of everything.
        checkpoint: the world model.
        scene_model: run or folder of a trained model of scenes; ``None`` to train one.
        renderer: run of a trained adapter that draws scenes; ``None`` to train one.
    """

    out: Path
    checkpoint: str = REFERENCE
    scene_model: str | None = None
    renderer: str | None = None

    @property
    def scene(self) -> str:
        """The model of scenes that is measured."""
        return str(self.out / "scene-outcome") if self.scene_model is None else self.scene_model

    @property
    def drawing(self) -> str:
        """The run whose adapter draws scenes."""
        return str(self.out / "renderer") if self.renderer is None else self.renderer


def commands(figures: SceneFigures) -> Iterator[str]:
    """Yield the command lines in order."""
    yield f"weights fetch {' '.join(WEIGHTS)}"
    home = shlex.quote(str(figures.out))
    for split, policies in {"train": HOUSES, "test": HELD_OUT}.items():
        for policy, scenes in policies.items():
            yield f"{COLLECT} --out {home}/{split}/{policy} --scenes {scenes} --policy {policy} --split {split}"
    yield from training_commands(figures)
    yield from measuring_commands(figures)


def training_commands(figures: SceneFigures) -> Iterator[str]:
    """Yield the command lines that train what is not given."""
    home, base = shlex.quote(str(figures.out)), f"base={shlex.quote(figures.checkpoint)}"
    kept = f"--cache {home}/cache --resume"
    data = " ".join([*(f"--data {home}/train/{policy}" for policy in HOUSES), kept])
    if figures.scene_model is None:
        yield f"finetune houses-64-scene-codec {data} --out {home}/codec"
        yield f"finetune houses-64-scene {data} --out {home}/scene base={home}/codec {TRAINED}"
        acted = f"--data {home}/train/interact {kept}"
        yield f"finetune houses-64-scene-outcome {acted} --out {home}/scene-outcome base={home}/scene"
    if figures.renderer is None:
        walks = f"--data {home}/train/path {kept}"
        yield f"finetune houses-64-stage2-scene {walks} --out {home}/renderer-true {base}"
        imagined = f"adapter_from={home}/renderer-true memory.settings.model={shlex.quote(figures.scene)}"
        yield f"finetune houses-64-stage2-scene-imagined {walks} --out {home}/renderer {base} {imagined}"


def measuring_commands(figures: SceneFigures) -> Iterator[str]:
    """Yield the command lines that measure."""
    home, packaged = shlex.quote(str(figures.out)), shlex.quote(figures.checkpoint)
    scene, renderer = shlex.quote(figures.scene), shlex.quote(figures.drawing)
    paths, interactions = f"--data {home}/test/path", f"--data {home}/test/interact"

    def bench(data: str, parts: str, name: str, options: str) -> str:
        seeds = "" if parts == "edits" else f"--seeds {SEEDS} "  # each edit has a seed of its own
        return (
            f"bench scene {scene} {data} --parts {parts} {seeds}{options} --out {home}/{name} "
            f"--report {home}/report-{name}"
        )

    yield bench(paths, "completion,walk,speed", "completion", f"--train {home}/train/path --houses 600 --walks 8")
    yield bench(interactions, "evolution", "evolution", "--interactions 200")
    for name, checkpoint, memories in (("packaged", packaged, MEMORIES), ("renderer", renderer, "scene")):
        yield bench(paths, "edits", f"edits-{name}", f"--checkpoint {checkpoint}")
        yield bench(paths, "return", f"return-{name}", f"--checkpoint {checkpoint} --memories {memories} --walks 8")
    yield bench(paths, "return", "long", f"--checkpoint {renderer} --walks 4 --return-steps 500")


def identity(figures: SceneFigures) -> dict[str, Any]:
    """Return JSON values of what is trained on and measured."""
    values = asdict(figures) | {"checkpoint": model_json(figures.checkpoint)}
    del values["out"]
    if figures.scene_model is not None:
        values["scene_model"] = find_scene_model(figures.scene_model).fingerprint
    if figures.renderer is not None:
        values["renderer"] = model_json(figures.renderer)
    return values


def main(arguments: Sequence[str]) -> None:
    """Run every command until one fails, and end with its exit code.

    Raises:
        PersistError: when the folder holds figures of something else, or what is named is not there.
    """
    parser = argparse.ArgumentParser(
        prog="python -m persist_cli.reproduce.scenes", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/scenes"), help="folder of everything")
    parser.add_argument("--checkpoint", default=REFERENCE, help="the world model; else that of the package")
    parser.add_argument("--scene-model", help="run of a trained model of scenes; else one is trained")
    parser.add_argument("--renderer", help="run of a trained adapter that draws scenes; else one is trained")
    parser.add_argument("--trial", action="store_true", help="every command in its smallest form, in OUT/trial")
    options = parser.parse_args(arguments)
    out, run = (trial_folder(options.out), run_small) if options.trial else (options.out, run_line)
    figures = SceneFigures(out, options.checkpoint, options.scene_model, options.renderer)
    keep_plan(figures.out, identity(figures), "*/metrics.json")
    for line in commands(figures):
        run(line)
    models = ["--model", figures.checkpoint, "--scene-model", figures.scene]
    scene_agents.main([str(figures.out / "agents"), *models, *(SMALL_AGENTS.split() if options.trial else [])])


if __name__ == "__main__":
    run_main(main)
