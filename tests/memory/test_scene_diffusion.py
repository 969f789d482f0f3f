"""The model of scenes on windows of random rooms: its codec, its diffusion, and what of a window it keeps."""

from __future__ import annotations

import itertools
from dataclasses import asdict, replace

import pytest
import torch

from persist_cli.api.cells import FREE, OUTSIDE, SOLID
from persist_cli.api.meta_device import without_weights
from persist_cli.api.scene_model import Given, SceneSamples
from persist_cli.api.stages import SCENE_STAGES
from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.settings import parse_settings
from persist_cli.plugins import make_scene_model
from persist_memory.scene_models.codec import channels_first, fold, unfold, unfolded_cells
from persist_memory.scene_models.conditions import changed_tokens, draw_levels, known_tokens, truth
from persist_memory.scene_models.scene_diffusion import (
    SceneDiffusion,
    generators_of,
    noise_levels,
    noise_like,
    start,
)
from persist_memory.scene_models.settings import SceneDiffusionSettings
from persist_memory.scene_models.specks import least_cells
from tests.support.micro_scenes import MICRO_SCENE, micro_model, micro_samples
from tests.support.random_scenes import PALETTE


@pytest.fixture(scope="module")
def samples():
    return micro_samples(3)


@pytest.fixture(scope="module")
def model():
    return micro_model()


@pytest.mark.parametrize("axes", [2, 3])
def test_folding_places_into_channels_can_be_undone(axes):
    values = torch.arange(2 * 3 * 4**axes).reshape(2, 3, *[4] * axes)
    folded = fold(values, 2)
    assert folded.shape == (2, 3 * 2**axes, *[2] * axes)
    assert unfold(folded, 2).equal(values)


def test_a_block_of_cells_becomes_the_channels_of_its_own_latent():
    values = torch.zeros(1, 1, 4, 4)
    values[..., 2:, :2] = 1.0
    assert fold(values, 2)[0, :, 1, 0].equal(torch.ones(4))
    assert fold(values, 2).sum() == 4


@pytest.mark.parametrize("folded", [True, False])
def test_given_cells_are_patched_as_by_the_convolution_whose_weights_they_have(folded, samples):
    network = micro_model(codec=MICRO_SCENE["codec"] | {"fold_levels": folded}).double()
    given = network.given
    told = (samples.given != Given.NOTHING).int()
    contents = told * (1 + samples.classes.int() + len(PALETTE) * (samples.given == Given.PAST))
    cells = torch.cat([given.contents(contents), samples.colors.double() / 255 * told[..., None]], dim=-1)
    convolved = given.patches(channels_first(cells, given.axes)).flatten(2).transpose(1, 2)
    held = torch.zeros(len(samples.given), network.settings.components, *network.settings.latents).double()
    assert torch.allclose(given(samples, held), convolved + given.latents.bias, rtol=1e-12, atol=1e-12)
    assert not torch.allclose(given(samples, held + 1), given(samples, held))


def test_classes_and_colours_are_read_off_as_by_one_product(model):
    latents = torch.randn(2, 8, 4, 4, generator=torch.Generator().manual_seed(0))
    parts = torch.cat(model.codec.read_off(latents), dim=-1)
    whole = model.codec.cell(unfolded_cells(model.codec.decoder(latents), 2, 8))
    assert torch.allclose(parts, whole, atol=1e-5)


@pytest.mark.parametrize("stage", ["scene-codec", "scene"])
def test_a_loss_does_not_depend_on_how_samples_are_batched(model, samples, stage):
    one_by_one = [model(SceneSamples.stack([sample]), stage)["loss"] for sample in micro_samples(3, stacked=False)]
    if stage == "scene":  # all of these views leave every token to be imagined
        assert torch.stack(one_by_one).mean().allclose(model(samples, stage)["loss"], atol=1e-5)
    assert model(samples, stage)["loss"].equal(model(samples, stage)["loss"])


@pytest.mark.parametrize("stage", ["scene-codec", "scene"])
def test_what_the_data_do_not_tell_counts_as_little_as_the_settings_say(samples, stage):
    """The mean over all cells is that of two halves of them, each of which was told alone."""
    told = torch.zeros(samples.given.shape, dtype=torch.bool)
    told[:, :8] = True  # whole tokens
    parts = [replace(samples, true_known=known) for known in (told, ~told, torch.ones_like(told))]
    name = {"scene-codec": "cross_entropy", "scene": "loss"}[stage]

    def losses(weight):
        model = micro_model(untold_weight=weight, codec=MICRO_SCENE["codec"] | {"rare_weight": 1.0})
        return [model(part, stage)[name].item() for part in (*parts, samples)]

    one, other, both, plain = losses(0.0)
    assert one != pytest.approx(other, rel=1e-4)
    assert both == plain == pytest.approx((one + other) / 2, rel=1e-5)
    assert losses(0.25)[0] == pytest.approx((one + 0.25 * other) / 1.25, rel=1e-5)
    assert losses(1.0)[0] == pytest.approx(both, rel=1e-5)


def test_each_stage_trains_its_own_part_and_all_parts_are_named_once(model, samples):
    codec, rest, outcomes = (set(model.trained_parameters(stage)) for stage in SCENE_STAGES)
    assert not codec & rest | codec & outcomes | rest & outcomes
    names = [name for group in model.parameter_groups() for name in group.parameters]
    assert sorted(names) == sorted(codec | rest | outcomes)
    model.trained_parameters("scene")
    model(samples, "scene")["loss"].backward()
    assert all(value.grad is None for name, value in model.named_parameters() if name not in rest)


def test_the_codec_learns_rooms_and_the_transformer_their_latents(samples):
    model = micro_model()
    for stage, steps in (("scene-codec", 35), ("scene", 35)):
        optimizer = torch.optim.AdamW(model.trained_parameters(stage).values(), 1e-2)
        losses = []
        for number in range(steps):
            batch = replace(samples, seeds=samples.seeds + 3 * number)
            losses.append(model(batch, stage)["loss"])
            losses[-1].backward()
            optimizer.step()
            optimizer.zero_grad()
        model.finish_stage(stage, [samples])
        assert sum(losses[-5:]) < 0.8 * sum(losses[:5])
    assert components_of(model, samples).var(1).mean().allclose(torch.tensor(1.0), atol=1e-3)


def components_of(model, samples):
    """What is generated of some windows, ``[component, place]``."""
    with torch.no_grad():
        return model.codec.encode(samples.true_classes, samples.true_colors).transpose(0, 1).flatten(1)


@pytest.mark.parametrize("evenness", [0.0, 0.5, 1.0])
def test_the_first_principal_components_of_latents_are_generated(samples, evenness):
    model = micro_model(codec=MICRO_SCENE["codec"] | {"components": 3, "evenness": evenness})
    with torch.no_grad():
        latents = model.codec.posterior(samples.true_classes, samples.true_colors)[0]
    model.finish_stage("scene-codec", [samples])
    spread = torch.linalg.eigvalsh(latents.transpose(0, 1).flatten(1).cov()).flip(0)[:3].sqrt() ** (1 - evenness)
    expected = torch.diag(spread**2 / (spread**2).mean())
    assert components_of(model, samples).cov().allclose(expected, atol=1e-4)
    assert model.sample(samples, 1)[0].shape == samples.classes.shape


def test_all_components_of_latents_are_decoded_as_the_latents_themselves(samples):
    model = micro_model()
    model.finish_stage("scene-codec", [samples])
    with torch.no_grad():
        latents = model.codec.posterior(samples.true_classes, samples.true_colors)[0]
        decoded = model.codec.decode(model.codec.encode(samples.true_classes, samples.true_colors))
        for ours, theirs in zip(decoded, model.codec.read_off(latents), strict=True):
            assert ours.allclose(theirs, atol=1e-4)


def test_given_cells_come_out_to_the_bit_and_solid_ones_as_something(model, samples):
    given = samples.given.clone()
    given[:, :8] = int(Given.CONTENT)  # as of a window beside one that is complete
    told = torch.where((given > 0) & (samples.given == 0), samples.true_classes, samples.classes)
    colors = torch.where((given > 0)[..., None], samples.true_colors, 0)
    classes, painted = model.sample(replace(samples, given=given, classes=told, colors=colors), 2)
    kept, named = given == Given.CONTENT, told != SOLID
    assert classes[kept & named].equal(told[kept & named])
    assert painted[kept].equal(colors[kept])
    assert (classes[kept & ~named] > 2).all()
    assert not (classes == SOLID).any()


def test_cells_are_reconstructed_as_the_codec_has_them_and_are_never_merely_solid(model, samples):
    classes, colors = model.reconstruct(samples.true_classes, samples.true_colors)
    with torch.no_grad():
        logits, _ = model.codec.decode(model.codec.encode(samples.true_classes, samples.true_colors))
    likeliest = (logits - model.codec.class_weights.log()).argmax(-1)
    assert classes[likeliest != SOLID].equal(likeliest[likeliest != SOLID].to(torch.uint8))
    assert not (classes == SOLID).any()
    assert not colors[classes == 0].any()


def test_doors_and_things_count_more_in_the_loss_of_the_codec(model):
    weights = dict(zip(model.settings.palette, model.weights.tolist(), strict=True))
    assert {name for name, weight in weights.items() if weight == 1} == {
        "free", "solid", "outside", "floor", "ceiling", "wall",
    }  # fmt: skip
    assert weights["door"] == weights["box"] == model.settings.codec.rare_weight > 1


def test_what_a_door_counts_more_in_training_is_divided_out_where_cells_are_read_off(samples, monkeypatch):
    model = micro_model()
    model.finish_stage("scene-codec", [samples])
    kinds, weight = {name: number for number, name in enumerate(model.settings.palette)}, model.weights.max()
    for share, read in ((0.9, "wall"), (1.1, "door")):
        logits = torch.full((*samples.true_classes.shape, len(kinds)), -9.0)
        logits[..., kinds["wall"]], logits[..., kinds["door"]] = 0.0, share * weight.log()
        monkeypatch.setattr(model.codec, "decode", lambda _, read_off=logits: (read_off, torch.zeros(1)))
        classes, _ = model.reconstruct(samples.true_classes, samples.true_colors)
        assert (classes == kinds[read]).all()


def test_a_sample_follows_from_its_seed_alone(model, samples):
    first, again = (model.sample(samples, 2) for _ in range(2))
    assert first[0].equal(again[0])
    alone = model.sample(SceneSamples.stack(micro_samples(2, stacked=False)[1:]), 2)
    assert (alone[0][0] == first[0][1]).float().mean() > 0.999  # kernels round differently in batches
    others = model.sample(replace(samples, seeds=samples.seeds + 9), 2)
    assert not others[0].equal(first[0])


def test_what_is_past_may_change(model, samples):
    past = torch.full_like(samples.given, int(Given.PAST))
    classes, _ = model.sample(replace(samples, given=past, classes=samples.true_classes), 1)
    assert not classes.equal(samples.true_classes)
    assert not known_tokens(replace(samples, given=past), model.settings).any()


PLACE = (1, -5, 2, 1)  # of the second window, in the last but one token along the first axis


def acted(samples, change=lambda classes, colors: None, given=Given.PAST):
    """Samples of cells that may all have changed, of which some truly do; one of them held a box."""
    classes, colors = samples.true_classes.clone(), samples.true_colors.clone()
    classes[PLACE] = PALETTE.index("box")
    before = {"classes": classes.clone(), "colors": colors.clone()}
    change(classes, colors)
    all_given = torch.full_like(samples.given, int(given))
    return replace(samples, given=all_given, **before, true_classes=classes, true_colors=colors)


def taken(classes, colors):
    """The box is gone."""
    classes[PLACE] = FREE


def painted_green(classes, colors):
    """The box has another colour."""
    colors[PLACE] = torch.tensor([3, 200, 4])


@pytest.mark.parametrize("folded", [True, False])
@pytest.mark.parametrize("change", [taken, painted_green])
def test_tokens_change_where_a_cell_does(samples, change, folded):
    settings = micro_model(codec=MICRO_SCENE["codec"] | {"fold_levels": folded}).settings
    changed = changed_tokens(acted(samples, change), settings).unflatten(1, settings.tokens)
    assert changed.nonzero().tolist() == [[1, settings.tokens[0] - 2, *[0] * (len(settings.tokens) - 1)]]
    assert not changed_tokens(acted(samples), settings).any()
    assert not changed_tokens(acted(samples, change, given=Given.CONTENT), settings).any()
    solid = (samples.true_classes != FREE) & (samples.true_classes != OUTSIDE)
    unnamed = replace(acted(samples), classes=torch.where(solid, SOLID, samples.true_classes))
    assert not changed_tokens(unnamed, settings).any()


def test_a_token_that_changes_counts_more_in_the_loss(samples):
    def loss(weight, change):
        model = micro_model(transformer=MICRO_SCENE["transformer"] | {"change_weight": weight})
        return model(acted(samples, change), "scene")["loss"].item()

    tokens = samples.given.shape[0] * 4 * 4  # of which one changes
    plain, more, most = (loss(weight, taken) for weight in (1.0, 9.0, 1e9))
    assert more == pytest.approx((tokens * plain + 8 * most) / (tokens + 8), rel=1e-4)
    assert most != pytest.approx(plain, rel=1e-2)
    assert loss(9.0, lambda classes, colors: None) == loss(1.0, lambda classes, colors: None)


@pytest.mark.parametrize(("before", "after"), [(FREE, "wall"), (SOLID, "wall"), ("door", "door")])
def test_a_speck_is_what_is_next_most_likely_unless_it_was_there_before(samples, monkeypatch, before, after):
    model = micro_model()
    model.codec.least_cells[PALETTE.index("door")] = 4
    number = {name: place for place, name in enumerate(PALETTE)} | {FREE: FREE, SOLID: SOLID}
    logits = torch.full((*samples.classes.shape, len(PALETTE)), -9.0)
    logits[..., FREE] = 2.0
    logits[1, 5, 5, 2, PALETTE.index("door")], logits[1, 5, 5, 2, PALETTE.index("wall")] = 4.0, 3.0
    monkeypatch.setattr(model.codec, "decode", lambda _: (logits.clone(), torch.zeros(*samples.classes.shape, 3)))
    given, told = torch.full_like(samples.given, int(Given.PAST)), torch.full_like(samples.classes, FREE)
    told[1, 5, 5, 2] = number[before]
    if before == SOLID:
        given[1, 5, 5, 2] = int(Given.CONTENT)
    classes, _ = model.sample(replace(samples, given=given, classes=told), 1)
    assert int(classes[1, 5, 5, 2]) == number[after]
    assert int((classes != FREE).sum()) == 1


def test_how_small_things_are_is_measured_with_the_codec_and_kept_in_its_file(samples, tmp_path):
    model, others = micro_model(), micro_model(seed=1)
    windows = torch.cat([samples.true_classes] * 9)
    many = replace(samples, true_classes=windows, true_colors=torch.cat([samples.true_colors] * 9))
    model.finish_stage("scene-codec", [many])
    assert model.codec.least_cells.equal(least_cells(windows, len(PALETTE)))
    assert model.codec.least_cells.max() > 1
    model.save(tmp_path, "scene-codec")
    others.load(tmp_path, "scene-codec")
    assert others.codec.least_cells.equal(model.codec.least_cells)


def test_true_cells_are_not_read_when_sampling(model, samples):
    blind = replace(samples, true_classes=None, true_colors=None)
    assert model.sample(blind, 2)[0].equal(model.sample(samples, 2)[0])
    with pytest.raises(CheckpointError, match="trained on samples with true cells"):
        model(blind, "scene")


def test_regions_have_noise_levels_of_their_own_in_some_samples(model):
    generators = [torch.Generator().manual_seed(seed) for seed in range(400)]
    levels = draw_levels(model.settings, generators)
    assert ((levels >= 0) & (levels <= 1)).all()
    own = (levels != levels[:, :1]).any(1).float().mean()
    assert float(own) == pytest.approx(model.settings.transformer.own_levels, abs=0.06)


def test_noise_levels_in_training_lie_as_densely_as_the_steps_of_sampling(model):
    levels = draw_levels(model.settings, [torch.Generator().manual_seed(seed) for seed in range(2000)])[:, 0]
    edges = noise_levels(10, model.settings.sampling.shift)
    for high, low in itertools.pairwise(edges):
        assert float(((levels > low) & (levels <= high)).float().mean()) == pytest.approx(0.1, abs=0.03)


@pytest.mark.parametrize(("snaps", "level", "early"), [(1, 0.9, True), (1, 0.2, False), (0, 0.2, True)])
def test_known_tokens_hold_in_training_what_they_hold_in_sampling(samples, snaps, level, early):
    model = micro_model(sampling={"snap_every": snaps})
    given = torch.zeros_like(samples.given)
    given[:, :8] = int(Given.CONTENT)
    told = replace(samples, given=given, classes=samples.true_classes * (given > 0))
    known = known_tokens(told, model.settings)
    assert bool(known.any())
    held = model._held(told)
    latents = model._latents(told, held, known, torch.full(known.shape, level).masked_fill(known, 0.0))
    with torch.no_grad():
        before, after = (model.codec.encode(*cells) for cells in (start(told, model.settings), truth(told)))
    tokens, before, after = (model._tokens(part) for part in (latents, before, after))
    assert tokens[~known].equal(after[~known])
    assert tokens[known].equal((before if early else after)[known])  # beside given cells is no room before a snap


def test_a_token_is_known_when_all_its_cells_are_settled(model, samples):
    given = torch.zeros_like(samples.given)
    given[:, :4, :4] = int(Given.CONTENT)
    free = replace(samples, given=given, classes=torch.full_like(samples.classes, FREE))
    assert known_tokens(free, model.settings).sum(1).tolist() == [1, 1, 1]
    assert not known_tokens(replace(free, classes=torch.full_like(given, SOLID)), model.settings).any()


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_noise_levels_fall_from_one_to_zero(shift):
    levels = noise_levels(5, shift)
    assert (levels[0], levels[-1]) == (1.0, 0.0)
    assert levels == sorted(levels, reverse=True)


def test_where_nothing_is_given_the_steps_are_those_of_the_scheduler_of_diffusers(samples):
    from diffusers import FlowMatchEulerDiscreteScheduler

    model, steps = moving(micro_model()), 6
    samples = replace(samples, given=torch.zeros_like(samples.given))
    scheduler = FlowMatchEulerDiscreteScheduler(shift=model.settings.sampling.shift)
    scheduler.set_timesteps(sigmas=[1 - step / steps for step in range(steps)])
    assert scheduler.sigmas.allclose(torch.tensor(noise_levels(steps, scheduler.shift)), atol=1e-6)
    with torch.no_grad():
        generators = generators_of(samples)
        held = model._held(samples)
        latents = noise_like(held, generators)
        told = model.tell(samples, held, generators, torch.zeros(len(samples.given), dtype=torch.bool))
        for level, timestep in zip(scheduler.sigmas, scheduler.timesteps, strict=False):
            of_tokens = level.expand(known_tokens(samples, model.settings).shape)
            velocity = model.transformer(latents, of_tokens, told.given, told.view, told.action)
            latents = scheduler.step(velocity, timestep, latents).prev_sample
        logits, _ = model._decoded(latents)
    assert (logits.argmax(-1) == model.sample(samples, steps)[0]).float().mean() > 0.999


def moving(model):
    """The model with a transformer whose velocities are not zero, as those of a new one are."""
    with torch.no_grad():
        for parameter in model.transformer.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    return model


def test_guidance_of_one_changes_nothing_and_more_changes_the_sample(samples):
    guided = moving(micro_model(sampling={"guidance": 3.0}))
    plain = micro_model()
    plain.load_state_dict(guided.state_dict())
    assert not guided.sample(samples, 2)[0].equal(plain.sample(samples, 2)[0])


def test_heights_are_folded_or_divided_by_configuration(samples):
    cubes = micro_model(shape=[16, 16, 8], codec=MICRO_SCENE["codec"] | {"fold_levels": False})
    assert cubes.settings.tokens == (4, 4, 2)
    classes, _ = cubes.sample(micro_samples(1, cubes.form), 1)
    assert classes.shape == (1, 16, 16, 8)
    patches = micro_model(transformer=MICRO_SCENE["transformer"] | {"patch": 2})
    assert patches.settings.tokens == (2, 2)
    assert patches.sample(samples, 1)[0].shape == samples.given.shape


def test_a_saved_model_is_loaded_to_the_bit_on_the_meta_device_too(model, samples, tmp_path):
    model.save(tmp_path, "scene")
    with without_weights():
        loaded = make_scene_model("scene", asdict(model.settings))
    loaded.load(tmp_path, "scene")
    assert loaded.sample(samples, 2)[0].equal(model.sample(samples, 2)[0])
    assert loaded(samples, "scene-codec")["loss"].equal(model(samples, "scene-codec")["loss"])


def test_a_codec_alone_leaves_the_rest_as_it_was(model, tmp_path):
    model.save(tmp_path, "scene-codec")
    assert [path.name for path in tmp_path.iterdir()] == ["codec.safetensors"]
    other = micro_model(seed=1)
    before = other.transformer.places.clone()
    other.load(tmp_path, "scene-codec")
    assert other.codec.classes.weight.equal(model.codec.classes.weight)
    assert other.transformer.places.equal(before)
    with pytest.raises(CheckpointError, match=r"transformer.safetensors: no such file"):
        other.load(tmp_path, "scene")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"palette": ["free", "floor", "wall"]}, "palette must begin with free, solid, outside"),
        ({"palette": [*PALETTE, "box"]}, "name each class once"),
        ({"shape": [18, 16, 8]}, "must be multiples of 4"),
        ({"shape": [16, 16, 6], "codec": {"fold_levels": False}}, "must be multiples of 4"),
        ({"image": [20, 16]}, "multiples of view_patch 8"),
        ({"transformer": {"width": 32}}, "must be a multiple of twice the heads"),
        ({"codec": {"latent": 8, "components": 9}}, "components 9 must be at most codec.latent, 8"),
    ],
)
def test_sizes_that_do_not_go_together_are_refused(change, message):
    with pytest.raises(RecipeError, match=message):
        parse_settings(SceneDiffusionSettings, {"palette": PALETTE} | change, "scene")


def test_the_levels_of_a_micro_window_are_seen_from_inside(samples):
    model = micro_model()
    origins, directions = model.view.rays(samples)
    points = origins + directions * samples.depth[:, None] / model.view.unit
    hits = points.permute(0, 2, 3, 1)[samples.depth > 0]
    cells = (hits * model.view.unit / 0.25 + (torch.tensor(model.form.shape) - 1) / 2).round()
    assert ((cells >= 0) & (cells < torch.tensor(model.form.shape))).all()
    assert isinstance(model, SceneDiffusion)
    assert len(generators_of(samples)) == 3
