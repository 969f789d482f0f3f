"""What a plugin returns wrongly is one line that names it, where it is taken."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from persist_cli.api.actions import walking_actions
from persist_cli.api.cameras import Cameras
from persist_cli.api.cost import Cost, Futures
from persist_cli.api.encoder import Encoder
from persist_cli.api.ground import Body, GroundMap
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.policy import Goal, Policy, Situation
from persist_cli.api.promises import (
    check_cells,
    check_costs,
    check_features,
    check_figures,
    check_generated,
    check_losses,
    check_parameters,
    check_points,
    check_policy,
    check_proposals,
    check_stored,
    check_tokens,
)
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import PluginError
from persist_cli.io.settings import NoSettings

TOKENS = MemoryTokens.of(torch.ones(5, 32), torch.ones(5, 3), torch.zeros(5, 3, dtype=torch.uint8))
LOSS = torch.ones(3, requires_grad=True)
CLASSES, COLORS = (torch.zeros(1, 2, 2, 3, *rest, dtype=torch.uint8) for rest in ((), (3,)))


def changed(**parts: object) -> MemoryTokens:
    """The tokens with other parts."""
    return replace(TOKENS, **parts)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("tokens", "cause"),
    [
        (None, "read gave None, not MemoryTokens"),
        ([TOKENS], "read gave a list, not MemoryTokens"),
        (MemoryTokens.stack([TOKENS]), r"features as float32 \[1, 5, 32\], not float32 \[token, …\]"),
        (changed(features=torch.ones(5, 32).half()), r"features as float16 \[5, 32\]"),
        (changed(positions=None), "tokens without positions"),
        (changed(positions=torch.ones(3, 3).double()), "several lengths: 5 features, 3 positions, 5 mask"),
        (changed(mask=torch.ones(5)), r"mask as float32 \[5\], not bool \[token\]"),
        (changed(colors=torch.ones(5, 3)), r"colors as float32 \[5, 3\], not uint8 \[token, 3\]"),
        (changed(origins=torch.full((5,), 7, dtype=torch.uint8)), "origins beyond 2"),
        (changed(features=torch.full((5, 32), torch.nan)), "not finite"),
        (changed(positions=torch.full((5, 3), torch.inf).double()), "not finite"),
        (changed(features=torch.ones(5, 32, requires_grad=True)), "features with a gradient; compute them under"),
        (changed(features=torch.ones(5, 31)), "31 features, where its encoder has 32"),
        (MemoryTokens.of(torch.ones(9, 32), torch.ones(9, 3)), "9 tokens of at most 8"),
    ],
)
def test_tokens_that_no_memory_promises_name_the_memory(tokens, cause):
    with pytest.raises(PluginError, match=f"^memory 'last': .*{cause}"):
        check_tokens(tokens, "last", 32, 8)


@pytest.mark.parametrize("tokens", [TOKENS, MemoryTokens.empty(32)])
def test_tokens_as_promised_pass(tokens):
    check_tokens(tokens, "last", 32, 8)


@pytest.mark.parametrize(
    ("features", "channels", "cause"),
    [
        (None, 4, r"encode gave None, not float \[frame, rows, columns, channel\]"),
        (torch.zeros(2, 3, 3, 4).numpy(), 4, "encode gave a ndarray"),
        (torch.zeros(2, 3, 3, 4, dtype=torch.uint8), 4, r"encode gave uint8 \[2, 3, 3, 4\], not float"),
        (torch.zeros(2, 9, 4), 4, r"float32 \[2, 9, 4\], not float \[frame"),
        (torch.zeros(1, 3, 3, 4), 4, r"not 2 frames of \[rows, columns, 4\]"),
        (torch.zeros(2, 4, 3, 3), 4, r"float32 \[2, 4, 3, 3\], not 2 frames"),
        (torch.zeros(2, 0, 3, 4), 4, r"float32 \[2, 0, 3, 4\], not 2 frames"),
        (torch.full((2, 3, 3, 4), torch.nan), 4, "features that are not finite"),
        (torch.zeros(2, 3, 3, 4), 4.0, "its channels are 4.0, not a number from 1 on"),
        (torch.zeros(2, 3, 3, 4), None, "its channels are None"),
    ],
)
def test_features_that_no_encoder_promises_name_the_encoder(features, channels, cause):
    with pytest.raises(PluginError, match=f"^encoder 'mine': .*{cause}"):
        check_features(features, "mine", channels, 2)


def test_features_in_half_precision_are_finite_however_many_there_are():
    check_features(torch.full((1, 64, 64, 32), 8.0, dtype=torch.float16), "fine", 32, 1)


def test_features_of_an_encoder_with_weights_have_no_gradient():
    class Learned(Encoder):
        channels = 4
        weight = torch.nn.Parameter(torch.ones(3, 4))

        def encode(self, rgb):
            return rgb.float() @ self.weight

    assert not Learned(NoSettings()).encoded(torch.zeros(1, 2, 2, 3, dtype=torch.uint8)).requires_grad


@pytest.mark.parametrize(
    ("rgb", "depth", "cause"),
    [
        (None, torch.zeros(1, 3, 4, 4), r"colours as None, not uint8 \[1, 3, 4, 4, 3\]"),
        (torch.zeros(1, 2, 4, 4, 3, dtype=torch.uint8), torch.zeros(1, 2, 4, 4), r"uint8 \[1, 2, 4, 4, 3\]"),
        (torch.zeros(1, 3, 4, 4, 3), torch.zeros(1, 3, 4, 4), "colours as float32"),
        (torch.zeros(1, 3, 4, 4, 3, dtype=torch.uint8), None, "depth as None"),
        (torch.zeros(1, 3, 4, 4, 3, dtype=torch.uint8), torch.zeros(1, 3, 4, 4, 1), "depth as float32"),
        (torch.zeros(1, 3, 4, 4, 3, dtype=torch.uint8), torch.full((1, 3, 4, 4), -1.0), "negative or not finite"),
        (torch.zeros(1, 3, 4, 4, 3, dtype=torch.uint8), torch.full((1, 3, 4, 4), torch.nan), "negative or not finite"),
    ],
)
def test_images_that_no_backbone_promises_name_the_backbone(rgb, depth, cause):
    with pytest.raises(PluginError, match=f"^backbone 'toy': gave .*{cause}"):
        check_generated((rgb, depth), "toy", (1, 3, 4, 4))


@pytest.mark.parametrize(
    ("losses", "cause"),
    [
        (LOSS.sum(), r"float32 \[\], not a mapping"),
        ({"error": LOSS.sum()}, "not a mapping of scalar tensors with 'loss'"),
        ({"loss": LOSS}, r"loss as float32 \[3\], not a scalar tensor"),
        ({"loss": LOSS.sum(), "error": 0.3}, "error as a float, not a scalar tensor"),
        ({"loss": LOSS.sum().detach()}, "a loss without a gradient"),
        ({"loss": LOSS.sum(), "step": LOSS.sum()}, "step, under which the log has something else"),
    ],
)
def test_losses_that_cannot_be_trained_on_name_the_model(losses, cause):
    with pytest.raises(PluginError, match=f"^Toy: forward gave .*{cause}"):
        check_losses(losses, "Toy")


@pytest.mark.parametrize(
    ("tensors", "cause"),
    [
        ([torch.ones(3)], "tensors gave a list"),
        ({"path:there": torch.ones(3)}, "a name 'path:there'"),
        ({3: torch.ones(3)}, "a name 3"),
        ({"cells": None}, "cells as None"),
        ({"cells": torch.ones(())}, r"cells as float32 \[\]"),
        ({"cells": torch.ones(3).numpy()}, "cells as a ndarray"),
        ({"cells": torch.ones(3, dtype=torch.complex64)}, "cells as complex64"),
        ({"cells": torch.ones(3, device="meta")}, "cells, whose values a safetensors file cannot hold"),
        ({"cells": torch.ones(3).to_sparse()}, "cells, whose values a safetensors file cannot hold"),
        ({"__metadata__": torch.ones(3)}, "a name '__metadata__'"),
    ],
)
def test_what_can_be_no_memory_file_names_the_memory(tensors, cause):
    with pytest.raises(PluginError, match=f"^memory 'last': tensors gave .*{cause}" if "gave" not in cause else cause):
        check_stored(tensors, "last", "path:")


@pytest.mark.parametrize(
    ("positions", "colors", "cause"),
    [
        (torch.ones(4, 2), torch.zeros(4, 3, dtype=torch.uint8), r"positions as float32 \[4, 2\]"),
        (torch.ones(4, 3), torch.zeros(5, 3, dtype=torch.uint8), r"colours as uint8 \[5, 3\], not uint8 \[4, 3\]"),
        (torch.full((4, 3), torch.nan), torch.zeros(4, 3, dtype=torch.uint8), "positions that are not finite"),
    ],
)
def test_points_that_cannot_be_drawn_name_the_memory(positions, colors, cause):
    with pytest.raises(PluginError, match=f"^memory 'last': points gave {cause}"):
        check_points(MapPoints(positions, colors), "last")


def test_points_of_another_kind_or_with_other_origins_name_the_memory():
    positions, colors = torch.ones(4, 3), torch.zeros(4, 3, dtype=torch.uint8)
    with pytest.raises(PluginError, match=r"^memory 'last': points gave a tuple, not MapPoints"):
        check_points((positions, colors), "last")
    with pytest.raises(PluginError, match=r"^memory 'last': points gave origins as uint8 \[1\], not uint8 \[4\]"):
        check_points(MapPoints(positions, colors, origins=torch.ones(1, dtype=torch.uint8)), "last")


@pytest.mark.parametrize(
    ("parts", "cause"),
    [
        ({"spread": math.nan}, "the spread nan"),
        ({"spread": "a"}, "the spread 'a'"),
        ({"spread": math.inf}, "the spread inf"),
        ({"rise": -1.0}, "the spread 0.05 and the rise -1.0, not metres"),
        ({"origins": torch.full((4,), 9, dtype=torch.uint8)}, "origins beyond 3"),
    ],
)
def test_points_of_no_size_or_of_unknown_origin_name_the_memory(parts, cause):
    points = MapPoints(torch.ones(4, 3), torch.zeros(4, 3, dtype=torch.uint8), **parts)
    with pytest.raises(PluginError, match=f"^memory 'last': points gave {cause}"):
        check_points(points, "last")


@pytest.mark.parametrize(
    ("size", "bounds", "cause"),
    [
        (None, None, "None bytes"),
        (math.nan, None, "nan bytes"),
        (3, 3, "the bounds 3, not two corners in metres"),
        (3, ("abc", "def"), r"the bounds \('abc', 'def'\)"),
        (3, ((0.0, 0.0), (1.0, 1.0)), "the bounds"),
        (3, ((0.0, 0.0, math.nan), (1.0, 1.0, 1.0)), "the bounds"),
    ],
)
def test_sizes_and_bounds_that_are_no_numbers_name_the_memory(size, bounds, cause):
    with pytest.raises(PluginError, match=f"^memory 'last': figures gave {cause}"):
        check_figures(MemoryFigures(3, size, bounds, 0), "last")


@pytest.mark.parametrize(("cells", "imagined"), [(3, 5), (3, -1), (3.5, 0), (torch.tensor(3), 0), (None, 0)])
def test_figures_that_are_no_numbers_of_items_name_the_memory(cells, imagined):
    with pytest.raises(PluginError, match=r"^memory 'last': figures gave"):
        check_figures(MemoryFigures(cells, 0, None, imagined), "last")


def test_figures_of_another_kind_name_the_memory():
    with pytest.raises(PluginError, match=r"^memory 'last': figures gave a int, not MemoryFigures"):
        check_figures(3, "last")


@pytest.mark.parametrize(
    ("proposed", "cause"),
    [
        (None, "None, not 2 sequences"),
        (torch.zeros(2, 3), r"float32 \[2, 3\], not 2 sequences"),
        ([], "0 of them, not 2 sequences"),
        ([("left",)] * 3, "3 of them, not 2 sequences"),
        (["left", "left"], "'left', not a sequence of actions"),
        ([("left",), 3], "3, not a sequence of actions"),
        ([("left",) * 5, ()], "5 actions of at most 4"),
        ([("left",), ("fly",)], "the action 'fly'; known: forward, left"),
    ],
)
def test_proposals_that_no_policy_promises_name_the_policy(proposed, cause):
    with pytest.raises(PluginError, match=f"^policy 'mine': propose gave {cause}"):
        check_proposals(proposed, "mine", ("forward", "left"), 4, 2)


@pytest.mark.parametrize(
    "costs", [None, [[0.1]], torch.zeros(3), torch.zeros(1, 3), torch.zeros(3, 2, dtype=torch.int)]
)
def test_costs_that_no_cost_promises_name_the_cost(costs):
    with pytest.raises(PluginError, match=r"^cost 'far': measure gave .*, not float \[3, 2\]"):
        check_costs(costs, "far", (3, 2))


@pytest.mark.parametrize(
    ("cells", "cause"),
    [
        (None, "sample gave None, not classes and colours"),
        ((CLASSES,), "sample gave a tuple, not classes and colours"),
        ((CLASSES.float(), COLORS), r"classes as float32 \[1, 2, 2, 3\], not uint8 \[1, 2, 2, 3\]"),
        ((CLASSES, COLORS[..., 0]), r"colours as uint8 \[1, 2, 2, 3\], not uint8 \[1, 2, 2, 3, 3\]"),
        ((CLASSES + 7, COLORS), "sample gave the class 7 of 3 classes"),
    ],
)
def test_cells_that_no_scene_model_promises_name_the_model(cells, cause):
    with pytest.raises(PluginError, match=f"^scene model 'rooms': .*{cause}"):
        check_cells(cells, "rooms", "sample", (1, 2, 2, 3), 3)


@pytest.mark.parametrize(
    ("parameters", "cause"),
    [
        (None, "None, not parameters by name"),
        ({"weight": torch.ones(3)}, "a dict, not parameters by name"),
        ({}, "none; there is nothing to train in this stage"),
    ],
)
def test_parameters_that_cannot_be_trained_name_the_model(parameters, cause):
    with pytest.raises(PluginError, match=f"^Toy: trained_parameters gave {cause}"):
        check_parameters(parameters, "Toy")


@pytest.mark.parametrize(
    ("frames", "longest", "cause"),
    [
        ("2", None, "its frames is '2', not a number from 1 on"),
        (0, None, "its frames is 0"),
        (1, "a", "its longest is 'a', not a number from 1 on, or None"),
        (1, 0, "its longest is 0"),
    ],
)
def test_a_policy_that_looks_nowhere_is_named(frames, longest, cause):
    with pytest.raises(PluginError, match=f"^policy 'mine': {cause}"):
        check_policy(SimpleNamespace(name="mine", frames=frames, longest=longest))


def test_a_cost_that_fits_no_body_is_named():
    class Lost(CarelessCost):
        name = "lost"

        def of_body(self, body):
            pass

    with pytest.raises(PluginError, match=r"^cost 'lost': of_body gave NoneType; it must return a cost"):
        Lost(NoSettings()).fitted(Body())


class Careless(Memory):
    """A memory whose methods change what they are given."""

    def write(self, observations):
        observations.rgb[0].zero_()

    def read(self, cameras, budget):
        cameras.world_from_camera[:, :3, 3] -= 1
        return MemoryTokens.empty(3)

    def tensors(self):
        return {}

    def restore(self, tensors):
        pass


class CarelessEncoder(Encoder):
    channels = 3

    def encode(self, rgb):
        return rgb.copy_(rgb.flip(0)).float()


class CarelessCost(Cost):
    def measure(self, futures, goal, ground):
        goal.rgb.mul_(0)
        return torch.zeros(futures.free.shape)


class CarelessPolicy(Policy):
    def propose(self, situation, horizon, count, generator):
        situation.seen.depth.clamp_(max=1)
        return [()] * count


def test_methods_that_change_what_they_are_given_are_named():
    cameras = Cameras(torch.eye(4).expand(2, 4, 4).clone(), torch.eye(3).expand(2, 3, 3).clone(), 4, 4)
    seen = Observations(torch.ones(2, 4, 4, 3, dtype=torch.uint8), torch.ones(2, 4, 4), cameras)
    goal, ground = Goal(seen.rgb[0].clone(), None, "house"), GroundMap.empty((0.0, -1.0, 0.0))
    memory = Careless(NoSettings(), CarelessEncoder(NoSettings()), FrameOfReference("house"))
    futures = Futures(seen.rgb[None], seen.depth[None], cameras.world_from_camera[None], torch.ones(1, 2) > 0)
    info = TrajectoryInfo("house", np.eye(3), 4, 4, (0.0, -1.0, 0.0), walking_actions(0.25, 15.0))
    cases = {
        "write changed observations.rgb": lambda: memory.memorize(seen),
        r"read changed cameras\[0\].world_from_camera": lambda: memory.recall([cameras], 4),
        "encode changed rgb": lambda: memory.encoder.encoded(seen.rgb),
        "measure changed goal.rgb": lambda: CarelessCost(NoSettings()).measured(futures, goal, ground),
        "propose changed situation.seen.depth": lambda: CarelessPolicy(NoSettings()).proposals(
            Situation(seen, info, goal, ground), 2, 1, torch.Generator()
        ),
    }
    for cause, call in cases.items():
        with pytest.raises(PluginError, match=f"{cause}, which it was given; it may change a clone"):
            call()
