import pytest

from persist_cli.recipe import apply_overrides, make_recipe, read_recipe, recipe_names, to_yaml
from persist_cli.world.errors import RecipeError


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_reads_and_says_how_to_run_it(name):
    from importlib import resources

    assert make_recipe(read_recipe(name), name).description
    text = (resources.files("persist_recipes") / f"{name}.yaml").read_text()
    assert text.startswith(f"# persist finetune {name} ")


def test_a_resolved_recipe_reads_back_as_itself(tmp_path):
    recipe = make_recipe(read_recipe("tiny-stage2-voxel"), "x")
    (tmp_path / "a.yaml").write_text(to_yaml(recipe))
    assert make_recipe(read_recipe(str(tmp_path / "a.yaml")), "x") == recipe


def test_overrides_reach_nested_settings():
    values = apply_overrides(
        read_recipe("tiny-stage1"), ["training.steps=7", "data.strides=[1, 2]", "backbone.settings.rays=printed"]
    )
    recipe = make_recipe(values, "x")
    assert (recipe.training.steps, recipe.data.strides) == (7, (1, 2))
    assert recipe.backbone.settings["rays"] == "printed"


@pytest.mark.parametrize(
    ("overrides", "cause"),
    [(["training.stpes=3"], "did you mean 'training.steps'"), (["training.steps=0"], "at least 1"),
     (["training.steps=soon"], "training.steps"), (["steps"], "KEY=VALUE"), (["stage=2"], "stage 2 needs a memory"),
     (["data.strides=[0]"], "data.strides"), (["data.clips_per_trajectory=-1"], "at least 0"),
     (["training.precision=fp8"], "training.precision"),
     (["training.batch=5", "training.accumulation=2"], "multiple of accumulation"),
     (["a=[1"], "cannot read the value")],
)  # fmt: skip
def test_what_is_wrong_with_a_recipe_is_one_line(overrides, cause):
    with pytest.raises(RecipeError, match=cause) as error:
        make_recipe(apply_overrides(read_recipe("tiny-stage1"), overrides), "tiny-stage1")
    assert "\n" not in str(error.value)


def test_unknown_missing_and_broken_recipes_are_one_line(tmp_path):
    (tmp_path / "a.yaml").write_text("stage: [")
    (tmp_path / "b.yaml").write_text("- 1")
    for name, cause in (
        ("tiny-stage3", "did you mean"),
        ("c.yaml", "no such recipe file"),
        (str(tmp_path / "a.yaml"), "not YAML"),
        (str(tmp_path / "b.yaml"), "a recipe is a mapping"),
    ):
        with pytest.raises(RecipeError, match=cause) as error:
            read_recipe(name)
        assert "\n" not in str(error.value)
