"""What interactions change, as a network says that looks at the cells before the agent."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch

from persist_cli.api.cells import FREE, SOLID
from persist_cli.api.reach import CHANGED
from persist_cli.api.scene_model import Given, SceneSamples
from tests.support.micro_scenes import micro_model, micro_samples
from tests.support.random_scenes import TABLE

PICK_UP, DROP, TOGGLE = 1, 2, 3
COLOR = torch.tensor([200, 30, 40], dtype=torch.uint8)


def level_camera(place, angle):
    """Pose of a camera at a place in metres that looks along an angle from the first axis."""
    ahead, aside = (math.cos(angle), math.sin(angle), 0.0), (math.sin(angle), -math.cos(angle), 0.0)
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([aside, (0.0, 0.0, -1.0), ahead]).T
    pose[:3, 3] = torch.tensor(place)
    return pose


def interaction(action, seed=0, angle=0.0):
    """A known room in which a thing stands three cells ahead, or is carried; what is in reach is past."""
    [sample] = micro_samples(1, stacked=False)
    classes = torch.zeros_like(sample.classes)
    classes[:, :, 0] = SOLID
    colors = torch.zeros_like(sample.colors)
    there, ahead = (classes.clone(), colors.clone()), (9, 8, 1)
    there[0][ahead], there[1][ahead] = TABLE, COLOR
    painted = there[1].clone()
    painted[ahead] = 255 - COLOR
    before = (classes, colors) if action == DROP else there
    after = {PICK_UP: (classes, colors), DROP: there, TOGGLE: (there[0], painted)}[action]
    pose = level_camera((6 * 0.25, 8 * 0.25, 5 * 0.25), angle)
    given = torch.full_like(sample.given, int(Given.CONTENT))
    given[6:15, 4:13] = int(Given.PAST)
    return replace(
        sample, given=given, classes=before[0], colors=before[1], window_from_camera=pose, seeds=torch.tensor(seed),
        action=torch.tensor(action), carried=torch.tensor(TABLE if action == DROP else 0),
        carried_color=COLOR if action == DROP else torch.zeros_like(COLOR),
        true_classes=after[0], true_colors=after[1],
    )  # fmt: skip


@pytest.fixture(scope="module")
def batch():
    return SceneSamples.stack([interaction(action) for action in (PICK_UP, DROP, TOGGLE)])


@pytest.fixture(scope="module")
def trained(batch):
    model = micro_model(outcome={"drop_action": 0.0})
    optimizer = torch.optim.AdamW(model.trained_parameters("scene-outcome").values(), 1e-2)
    for _ in range(60):
        optimizer.zero_grad()
        model(batch, "scene-outcome")["loss"].backward()
        optimizer.step()
    model.knows_outcomes = True
    return model


def test_it_learns_what_each_action_makes_of_the_same_cell(trained, batch):
    classes, colors = trained.outcome(batch)
    assert classes.equal(batch.true_classes)
    assert (colors.int() - batch.true_colors.int()).abs().max() < 40
    losses = trained(batch, "scene-outcome")
    assert (float(losses["missed"]), float(losses["false"])) == (0, 0)


def test_cells_that_do_not_change_come_out_as_they_went_in(trained, batch):
    classes, colors = trained.outcome(batch)
    changed = (classes != batch.classes) | (colors != batch.colors).any(-1)
    assert changed.flatten(1).sum(1).tolist() == [1, 1, 1]
    assert changed[:, 9, 8, 1].all()


def test_only_past_cells_change(trained, batch):
    everything = changing_everything(trained)
    given = torch.where(batch.given == Given.PAST, int(Given.CONTENT), batch.given.int()).to(torch.uint8)
    given[:, 9, 8, 1] = int(Given.PAST)
    classes, colors = everything.outcome(replace(batch, given=given))
    changed = (classes != batch.classes) | (colors != batch.colors).any(-1)
    assert changed.any()
    changed[:, 9, 8, 1] = False
    assert not changed.any()


def test_it_looks_from_where_the_agent_stands(trained):
    """The same room, a whole cell aside along the second axis, in which all that is told lies a cell aside too."""
    sample = interaction(PICK_UP)
    moved = {name: part.roll(1, dims=1) for name, part in sample.tensors().items() if part.ndim in (3, 4)}
    moved = {name: part for name, part in moved.items() if name in ("given", "classes", "colors")}
    pose = sample.window_from_camera.clone()
    pose[1, 3] += 0.25
    aside = replace(sample, **moved, window_from_camera=pose)
    classes = trained.outcome(SceneSamples.stack([sample, aside]))[0]
    assert classes[1].equal(classes[0].roll(1, dims=1))
    assert int(classes[0][9, 8, 1]) == FREE


@pytest.mark.parametrize("angle", [0.0, 0.6, -0.7])
def test_places_are_metres_ahead_beside_and_above(angle):
    model = micro_model()
    around = model.outcomes.around(SceneSamples.stack([interaction(PICK_UP, angle=angle)]))
    row, column = (6 - 3, 8 - math.ceil(CHANGED / 0.25))
    assert (int(around.rows[0, 0, 0]), int(around.columns[0, 0, 0])) == (row, max(0, column))
    straight = (math.cos(angle) * 0.75, -math.sin(angle) * 0.75, (1 - 5) * 0.25)  # of cell (9, 8, 1)
    place = around.places[0, 6, math.ceil(CHANGED / 0.25), 1]
    assert place.tolist() == pytest.approx(straight, abs=1e-6)


def test_cells_beyond_the_window_are_nothing_and_never_change(trained):
    at_the_side = replace(interaction(PICK_UP), window_from_camera=level_camera((3.75, 2.0, 1.25), 0.0))
    samples = SceneSamples.stack([at_the_side])
    around = trained.outcomes.around(samples)
    assert not around.inside[0, 4:].any()
    assert around.rows.max() == 15
    everything = changing_everything(trained)
    changed = everything.outcome(samples)[0] != samples.classes
    inside = torch.zeros_like(changed)
    inside[0, 12:, :] = True
    assert changed.any()
    assert not (changed & ~inside).any()
    bordered = samples.classes.clone()
    bordered[:, -1, :3] = TABLE  # cells at the side, whose numbers those beyond have, but aside of the agent
    said, others = (trained.outcomes(replace(samples, classes=part), around)[0] for part in (samples.classes, bordered))
    assert said.shape == others.shape


def changing_everything(model):
    """The same model, for which each cell changes."""
    model = copy.deepcopy(model)
    model.outcomes.last.bias.data[0] = 1000.0
    return model


def test_a_model_that_was_not_trained_on_outcomes_says_none(trained, batch, tmp_path):
    trained.save(tmp_path, "scene-outcome")
    again, before = micro_model(seed=1), micro_model(seed=1)
    again.load(tmp_path, "scene-outcome")
    before.load(tmp_path, "scene")
    assert again.outcome(batch)[0].equal(trained.outcome(batch)[0])
    assert before.outcome(batch) is None


def test_a_batch_has_the_mean_loss_of_its_samples(trained, batch):
    alone = [trained(SceneSamples.stack([interaction(a)]), "scene-outcome")["loss"] for a in (PICK_UP, DROP, TOGGLE)]
    assert torch.stack(alone).mean().allclose(trained(batch, "scene-outcome")["loss"], rtol=1e-4)


def test_some_samples_are_not_told_the_action(batch):
    model = micro_model(outcome={"drop_action": 0.5})
    idle = replace(batch, action=torch.zeros_like(batch.action))
    losses = [model(replace(batch, seeds=batch.seeds + seed), "scene-outcome")["loss"] for seed in range(20)]
    told, untold = (
        micro_model(outcome={"drop_action": 0.0})(part, "scene-outcome")["loss"].item() for part in (batch, idle)
    )
    known = [pytest.approx(value, rel=1e-6) for value in (told, untold)]
    assert all(any(loss.item() == value for loss in losses) for value in known)
    assert model(batch, "scene-outcome")["loss"].equal(model(batch, "scene-outcome")["loss"])
