"""``persist bench plan`` in a small house: rows, resuming, files and what it refuses."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from persist_cli.api.policy import Policy
from persist_cli.bench.plans.journal import check_row_folders
from persist_cli.bench.plans.pictures import end_words
from persist_cli.bench.plans.plan_bench import EpisodeSource
from persist_cli.episodes.episodes import EpisodeSet
from persist_cli.episodes.rows import PlanningRow
from persist_cli.errors import DataError
from persist_cli.metrics.lpips import ALEX, tensor_shapes
from persist_cli.policies.open_policy import open_policy
from tests.conftest import CommandResult, Persist
from tests.support.micro_runs import run_persist
from tests.support.miniworlds import make_world
from tests.support.packages import install
from tests.support.predictions import cache_random
from tests.support.processes import run_command, run_in_pair
from tests.support.small_house import SETTINGS, as_set, episodes_in

Bench = Callable[..., CommandResult]

PLACE = ("--cost", "distance", "--rows", "random,rank-12", "--memories", "simulator", "--loops", "closed")

SEARCH = ("--cost", "distance", "--rows", "cem", "--memories", "simulator")

SIMULATED = ("--memories", "simulator", "--candidates", 2, "--rounds", 1)

TIMES = {"seconds_per_decision", "writing_per_decision", "open_seconds"}


@pytest.fixture(scope="module")
def episodes() -> EpisodeSet:
    """The episodes of the small house."""
    return as_set(episodes_in(make_world(**SETTINGS)))


@pytest.fixture
def bench(persist: Persist, episodes: EpisodeSet, tmp_path: Path) -> Bench:
    """A function that runs the benchmark on the episodes of the small house."""
    episodes.write(tmp_path / "episodes.json")

    def run(*options: object, out: str = "bench") -> CommandResult:
        return persist("bench", "plan", "--episodes", tmp_path / "episodes.json", "--out", tmp_path / out, *options)

    return run


EASY = ("--cost", "distance", "--loops", "closed", "--bins", 8, "--patience", 1)


@pytest.fixture(scope="module")
def random_row(episodes: EpisodeSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a benchmark of the row ``random``, without a model."""
    folder = tmp_path_factory.mktemp("random")
    episodes.write(folder / "episodes.json")
    files = ("--episodes", folder / "episodes.json", "--out", folder / "bench")
    run_persist("bench", "plan", *map(str, (*files, *EASY, "--rows", "random")))
    return folder / "bench"


@pytest.fixture
def begun(bench: Bench, random_row: Path, tmp_path: Path) -> Bench:
    """The function, which goes on with that benchmark."""
    shutil.copytree(random_row, tmp_path / "bench")
    return bench


def records(folder: Path) -> dict[str, Any]:
    """All that was kept of the episodes, without times."""
    found = {}
    for file in sorted((folder / "parts").glob("*/*.json")):
        record = json.loads(file.read_text())
        for loop in ("closed", "open"):
            for name in TIMES & set((record[loop] or {"figures": {}})["figures"]):
                del record[loop]["figures"][name]
        found[f"{file.parent.name}/{file.name}"] = record
    return found


def test_the_simulator_as_the_model_beats_random_on_easy_goals(bench: Bench, tmp_path: Path) -> None:
    ended = bench(*PLACE, "--json", "--report", tmp_path / "report")
    assert ended.code == 0, ended.err
    results = json.loads(ended.out)
    rows = results["tables"][0]["rows"]
    assert rows["rank-12, simulator"]["success"]["mean"] == 1 > rows["random"]["success"]["mean"]
    assert rows["rank-12, simulator"]["frames_per_decision"]["mean"] == 0  # the distance looks at poses alone
    assert "rank-12, simulator − random" in (tmp_path / "bench/tables.md").read_text()
    assert json.loads((tmp_path / "bench/metrics.json").read_text())["tables"] == results["tables"]
    page = (tmp_path / "report/report.html").read_text()
    assert len(list((tmp_path / "report/maps").glob("*.png"))) == page.count('class="map"') == 3
    assert not re.search(r'(src|href)="(?!data:)', page)  # it needs no other file


def test_the_classical_policy_finds_goals_whose_place_is_given(bench: Bench) -> None:
    ended = bench("--cost", "distance", "--rows", "shortest-path", "--loops", "closed", "--json")
    assert ended.code == 0, ended.err
    row = json.loads(ended.out)["tables"][0]["rows"]["shortest-path"]
    assert (row["success"]["mean"], row["spl"]["mean"] > 0.6) == (1.0, True)


def test_a_stopped_run_that_goes_on_ends_as_an_uninterrupted_one(bench: Bench, tmp_path: Path) -> None:
    short = (*PLACE, "--patience", 1, "--bins", 8)
    for out in ("whole", "stopped"):
        assert bench(*short, out=out).code == 0
    whole, files = records(tmp_path / "whole"), sorted((tmp_path / "stopped/parts").glob("*/*.json"))
    kept = files[0].stat().st_mtime_ns
    for file in files[1:]:
        file.unlink()
    assert bench(*short, out="stopped").code == 0
    assert records(tmp_path / "stopped") == whole
    assert files[0].stat().st_mtime_ns == kept


def test_two_processes_keep_what_one_does(bench: Bench, tmp_path: Path) -> None:
    short = ("--cost", "distance", "--rows", "random,straight", "--loops", "closed", "--patience", "1")
    assert bench(*short, out="one").code == 0
    command = ("bench", "plan", "--episodes", str(tmp_path / "episodes.json"), "--out", str(tmp_path / "two"), *short)
    assert run_in_pair(run_command, [*command], output=tmp_path) == [0, 0], (tmp_path / "0.log").read_text()
    assert records(tmp_path / "two") == records(tmp_path / "one")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--patience", "inf"), "--patience inf: give a number from 1 on; it must be finite"),
        (
            ("--frames", 6, "--horizon", 6, "--loops", "open"),
            "a plan has up to 8 actions; give 8 or more, or --loops closed",
        ),
        (("--frames", 6, "--horizon", 9), "a plan has up to 9 actions; give 9 or more, or a shorter --horizon"),
    ],
)
def test_settings_that_end_no_episode_are_one_line_before_any_is_run(bench, tmp_path, options, message) -> None:
    ended = bench(*PLACE, "--bins", 8, *options)
    assert (ended.code, ended.err.count("\n"), message in ended.err) == (1, 1, True), ended.err
    assert not (tmp_path / "bench").exists()


def test_two_rows_that_would_be_kept_in_one_place_are_refused(bench: Bench, tmp_path: Path) -> None:
    options = ("--cost", "distance", "--loops", "closed", "--patience", 1, "--rows", "straight")
    assert bench(*options).code == 0
    file = next((tmp_path / "bench/parts/straight").iterdir())
    file.write_text(json.dumps(json.loads(file.read_text()) | {"row": "Straight"}))
    ended = bench(*options)
    assert (ended.code, "holds the row 'Straight', 'straight' would be kept there too" in ended.err) == (1, True)


def test_rows_of_one_folder_are_refused_before_any_is_run() -> None:
    memories = ("voxel_2", "none", "voxel-2")
    rows = [
        PlanningRow(name=f"rank-8, {name}", planner="rank", policy="random", memory=name, goal="image", walk=False)
        for name in memories
    ]
    check_row_folders(rows[:2])
    with pytest.raises(DataError, match="'rank-8, voxel_2' and 'rank-8, voxel-2' would be kept in one folder"):
        check_row_folders(rows)


@pytest.mark.parametrize(("option", "cause"), [("--rows", "no row is left"), ("--bins", "whole numbers separated")])
def test_an_empty_list_of_rows_or_bins_is_not_taken_for_the_usual_one(bench: Bench, option: str, cause: str) -> None:
    ended = bench(option, "")
    assert (ended.code, cause in ended.err) == (1, True), ended.err


def test_rows_can_be_added_but_other_settings_are_refused(bench: Bench) -> None:
    options = ("--cost", "distance", "--loops", "closed", "--patience", 1)
    assert bench(*options, "--rows", "random").code == 0
    added = bench(*options, "--rows", "random,straight", "--json")
    assert list(json.loads(added.out)["tables"][0]["rows"]) == ["random", "straight"]
    refused = bench(*options, "--rows", "random", "--horizon", 5)
    assert refused.code == 1
    assert "holds another benchmark (planning horizon: 8, now 5)" in refused.err


def test_a_benchmark_does_not_go_on_with_an_edited_cost_of_another_package(bench: Bench, site: Path) -> None:
    code = "from persist_cli.costs.places import DistanceCost\nclass Air(DistanceCost): pass\n"
    install(site, "persist-air", "persist.costs", "air = air_line:Air", code)
    options = ("--cost", "air", "--loops", "closed", "--patience", 1, "--rows", "random")
    assert [bench(*options).code, bench(*options).code] == [0, 0]
    (site / "air_line.py").write_text(code + "# a change\n")
    refused = bench(*options)
    assert (refused.code, "holds another benchmark (code cost air: persist-air 1.2, c" in refused.err) == (1, True)


def test_a_file_of_episodes_is_known_by_what_it_holds_whatever_a_later_persist_adds(
    episodes: EpisodeSet, tmp_path: Path
) -> None:
    file, held = tmp_path / "episodes.json", episodes.model_dump(mode="json")
    del held["goal_gap"]  # came later
    file.write_text(json.dumps(held))
    digest = hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()
    assert EpisodeSource.of(file, None, None, None).identity() == {"sha256": digest}


def test_a_benchmark_that_named_its_episodes_with_what_the_file_leaves_unset_goes_on(
    bench: Bench, tmp_path: Path
) -> None:
    file, options = tmp_path / "episodes.json", ("--cost", "distance", "--loops", "closed", "--rows", "straight")
    held = json.loads(file.read_text())
    del held["goal_gap"]
    file.write_text(json.dumps(held))
    assert bench(*options, "--patience", 1).code == 0
    plan = tmp_path / "bench/parts/plan.json"
    source, values = EpisodeSource.of(file, None, None, None), json.loads(plan.read_text())
    assert values["episodes"] == source.identity() != source.identity(unset=True)
    plan.write_text(json.dumps(values | {"episodes": source.identity(unset=True)}))
    assert bench(*options, "--patience", 1).code == 0
    file.write_text(json.dumps(held | {"goal_gap": 1.0}))
    assert "holds another benchmark (episodes sha256" in bench(*options, "--patience", 1).err


def test_rows_with_a_model_can_be_added_to_a_benchmark_begun_without_one(begun: Bench, voxel: Path) -> None:
    options = (*EASY, "--memories", "none")
    added = begun(voxel, *options, "--steps", 1, "--rows", "random,rank-1", "--json")
    assert added.code == 0, added.err
    assert list(json.loads(added.out)["tables"][0]["rows"]) == ["random", "rank-1, none"]
    assert begun(*options, "--rows", "random").code == 0  # rows without a model still go on
    refused = begun(voxel, *options, "--steps", 2, "--rows", "random,rank-1")
    assert "holds another benchmark (sampling steps: 1, now 2)" in refused.err


def test_rows_of_cem_with_settings_of_their_own_can_be_added_to_a_benchmark_begun_without_them(begun: Bench) -> None:
    added = begun(*EASY, "--rows", "random,cem", *SIMULATED, "--set", "method.kept=0.3", "--json")
    assert added.code == 0, added.err
    assert list(json.loads(added.out)["tables"][0]["rows"]) == ["random", "cem, simulator"]
    assert begun(*EASY, "--rows", "random").code == 0  # rows without it still go on
    refused = begun(*EASY, "--rows", "random,cem", *SIMULATED)
    assert "holds another benchmark (planning cem: {'kept': 0.3}, now None)" in refused.err


def test_a_benchmark_of_an_earlier_persist_that_had_settings_of_cem_without_a_row_of_it_goes_on(
    begun: Bench, tmp_path: Path
) -> None:
    plan = tmp_path / "bench/parts/plan.json"
    values = json.loads(plan.read_text())
    plan.write_text(json.dumps(values | {"cem candidates": 2, "planning": values["planning"] | {"rounds": 1}}))
    assert begun(*EASY, "--rows", "random,cem", *SIMULATED).code == 0


def test_rows_of_one_policy_open_it_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    def open_once_more(name: str) -> Policy:
        opened.append(name)
        return open_policy(name)

    monkeypatch.setattr("persist_cli.bench.plans.plan_bench.open_policy", open_once_more)
    options = ("--cost", "distance", "--loops", "closed", "--bins", 8, "--patience", 1, "--memories", "simulator")
    ended = bench(*options, "--policy", "straight", "--rows", "policy,rank-1,random")
    assert (ended.code, opened) == (0, ["straight", "random"]), ended.err


def test_a_model_that_was_trained_on_the_scenes_of_a_begun_benchmark_is_refused(
    begun: Bench, voxel: Path, episodes: EpisodeSet, tmp_path: Path
) -> None:
    options = (*EASY, "--memories", "none")
    file = tmp_path / "bench/episodes.json"
    file.write_text(file.read_text().replace(episodes.scenes[0], "room-0"))
    refused = begun(voxel, *options, "--rows", "rank-1")
    assert "scene 'room-0': the model was trained on it" in refused.err
    assert begun(*options, "--rows", "random", "--json").code == 0  # and nothing of the model was kept


def test_what_cem_did_before_it_forgot_plans_that_were_done_is_refused(bench: Bench, tmp_path: Path) -> None:
    options = ("--cost", "distance", "--loops", "closed", "--bins", 8, "--patience", 1, "--rows", "cem", *SIMULATED)
    assert bench(*options).code == 0
    file = next((tmp_path / "bench/parts/cem-simulator").iterdir())
    record = json.loads(file.read_text())
    del record["version"]
    file.write_text(json.dumps(record))
    assert "was run when cem still judged the end of a plan that was done; delete this folder" in bench(*options).err


def test_how_cem_searches_can_be_set_and_a_benchmark_begun_before_goes_on(bench: Bench, tmp_path: Path) -> None:
    options = ("--cost", "distance", "--loops", "closed", "--bins", 8, "--patience", 1, "--rows", "cem", *SIMULATED)
    usual = json.loads(bench(*options, "--json").out)["settings"]["planning"]
    held = json.loads((tmp_path / "bench/parts/plan.json").read_text())["planning"]
    assert (usual, "cem" in held) == (held, False)  # as before anything of it could be set
    assert bench(*options, "--set", "method.shift=0.5").code == 0  # which it is anyway
    changed = ("--set", "method.kept=0.3", "--set", "method.elites=0.5")
    assert "holds another benchmark (planning cem: None, now {'elites': 0.5, 'kept'" in bench(*options, *changed).err
    other = json.loads(bench(*options, *changed, "--json", out="other").out)
    assert other["settings"]["planning"] == usual | {"cem": {"elites": 0.5, "kept": 0.3}}


def test_soft_spl_of_older_records_is_made_again_from_what_they_hold(bench: Bench, tmp_path: Path) -> None:
    options = ("--cost", "distance", "--loops", "closed", "--patience", 1, "--rows", "random", "--json")
    now = json.loads(bench(*options).out)["tables"][0]["rows"]["random"]
    for file in (tmp_path / "bench/parts/random").iterdir():
        record = json.loads(file.read_text())
        del record["closed"]["figures"]["start_metres"]
        record["closed"]["figures"]["soft_spl"] = 0.9
        file.write_text(json.dumps(record))
    again = json.loads(bench(*options).out)["tables"][0]["rows"]["random"]
    assert again["soft_spl"]["mean"] == pytest.approx(now["soft_spl"]["mean"], abs=1e-3) != 0.9


def test_an_episode_that_ended_where_no_way_is_known_can_be_told() -> None:
    figures = {"success": 0.0, "end_metres": None, "actions": 4.0}
    assert end_words({"figures": figures, "ended": "stopped"}) == "stopped, no way to the goal known, 4 actions"


def test_figures_of_an_agent_that_was_given_more_are_refused(bench: Bench, tmp_path: Path) -> None:
    options = ("--cost", "distance", "--loops", "closed", "--patience", 1, "--rows", "straight")
    assert bench(*options).code == 0
    file = next((tmp_path / "bench/parts/straight").iterdir())
    file.write_text(json.dumps(json.loads(file.read_text()) | {"walk": True}))
    refused = bench(*options)
    assert refused.code == 1
    assert "was run when 'straight' was given the walk; delete this folder" in refused.err


@pytest.fixture
def random_lpips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random weights of LPIPS, and no others."""
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    cache_random(tmp_path / "cache", "lpips-alex", tensor_shapes(ALEX))


def test_a_world_model_is_ranked_by_what_it_imagines(bench: Bench, voxel: Path, random_lpips: None) -> None:
    model = (voxel, "--steps", 1, "--rows", "rank-2,cem", "--memories", "none,voxel", "--candidates", 3, "--rounds", 1)
    limits = ("--bins", 8, "--patience", 1, "--horizon", 3, "--stop-cost", -1)
    ended = bench(*model, *limits, "--json")
    assert ended.code == 0, ended.err
    results = json.loads(ended.out)
    rows = results["tables"][0]["rows"]
    assert list(rows) == ["rank-2, none", "rank-2, voxel", "cem, none", "cem, voxel"]
    assert {row["success"]["mean"] for row in rows.values()} == {0.0}  # no view costs less than nothing
    assert set(rows["rank-2, voxel"]["success"]["differences"]) == {"rank-2, none"}
    assert "lpips" in rows["cem, none"]
    assert "sim" not in rows["cem, none"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((*PLACE, "--loops", "shut"), "unknown loop 'shut'"),
        ((*PLACE[:2], "--rows", "random", "--bins", "64"), "no episode of 64 actions"),
        (("--cost", "distanc"), "did you mean 'distance'"),
        (("--seconds", "inf"), "a budget of inf seconds; give --seconds above 0"),
        (("--stop-cost", "nan"), "--stop-cost nan: give a finite number"),
        (("--episodes", "e.json", "--each", 3), "--scenes and --each: of episodes that are drawn"),
        ((*SEARCH, "--set", "method.elits=0.1"), "unknown key 'elits', did you mean 'elites'?"),
        ((*SEARCH, "--set", "method.elites=2"), "elites 2 is a share"),
        ((*SEARCH, "--set", "method.horizon=4"), "--set method.horizon: give --horizon"),
        ((*SEARCH, "--set", "cost.unknown=4"), "write method.KEY=VALUE"),
        ((*SEARCH, "--no-keep", "--set", "method.shift=1"), "--no-keep begins each plan anew"),
        (
            (*PLACE, "--set", "method.elites=0.1"),
            "--set method.elites: no row has the cross-entropy method; add cem to --rows, or leave it out",
        ),
        ((*PLACE, "--candidates", 60), "--candidates: no row has the cross-entropy method; add cem to --rows"),
        ((*PLACE, "--rounds", 2, "--candidates", 9), "--candidates, --rounds: no row has the cross-entropy method"),
        ((*PLACE, "--steps", 4), "how to sample is given, but no row has the world model"),
        ((*PLACE, "--save-memory", "vae-slicing"), "how to sample is given, but no row has the world model"),
        ((*PLACE, "--stop-cost", 0.2), "--stop-cost 0.2: agents that are told the place of their goal stop there"),
        (("nowhere", *PLACE), "nowhere"),
        ((*PLACE, "--frames", 0), "a budget of 0 frames imagines nothing"),
        ((*PLACE, "--seconds", "nan"), "a budget of nan seconds"),
        (("--cost", "distance", "--rows", "policy", "--policy", "rndom"), "unknown policy 'rndom'"),
    ],
)
def test_bad_options_are_one_line(bench: Bench, tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    ended = bench(*options)
    assert ended.code == 1
    assert message in ended.err
    assert len(ended.err.strip().splitlines()) == 1
    assert not (tmp_path / "bench/metrics.json").exists()


def test_a_memory_that_the_model_lacks_is_refused_before_episodes_are_looked_for(
    persist: Persist, voxel: Path, tmp_path: Path
) -> None:
    options = ("--episodes", tmp_path / "none-yet.json", "--cost", "geodesic", "--rows", "rank-2")
    ended = persist("bench", "plan", voxel, *options, "--memories", "map2d", "--out", tmp_path / "bench")
    assert ended.code == 1
    assert "map2d" in ended.err
    assert len(ended.err.strip().splitlines()) == 1


def test_a_sampling_that_the_model_cannot_do_is_refused_before_any_row_is_run(
    bench: Bench, voxel: Path, tmp_path: Path
) -> None:
    rows = ("--cost", "distance", "--rows", "random,rank-2", "--memories", "none", "--loops", "closed")
    ended = bench(voxel, *rows, "--autoguidance", 3)
    assert (ended.code, "autoguidance of 3: this checkpoint has no guide" in ended.err) == (1, True), ended.err
    assert not (tmp_path / "bench").exists()


def test_episodes_of_another_image_size_are_refused(
    persist: Persist, voxel: Path, episodes: EpisodeSet, tmp_path: Path
) -> None:
    larger = episodes.model_copy(update={"settings": {"height": 64, "width": 64}})
    larger.write(tmp_path / "larger.json")
    options = ("--cost", "distance", "--rows", "rank-2", "--memories", "voxel", "--out", tmp_path / "bench")
    ended = persist("bench", "plan", voxel, "--episodes", tmp_path / "larger.json", *options)
    assert ended.code == 1
    assert "images of 64x64 pixels" in ended.err
    assert "--size 32x32" in ended.err


def test_a_trained_policy_acts_alone_and_proposes_what_is_ranked(
    bench: Bench, policy_run: Path, random_lpips: None
) -> None:
    options = ("--policy", policy_run, "--rows", "policy,rank-2", "--memories", "simulator", "--stop-cost", -1)
    ended = bench(*options, "--loops", "closed", "--bins", 8, "--patience", 1, "--json")
    assert ended.code == 0, ended.err
    rows = json.loads(ended.out)["tables"][0]["rows"]
    assert list(rows) == ["policy", "rank-2, simulator"]
    assert set(rows["rank-2, simulator"]["success"]["differences"]) == {"policy"}


def test_a_policy_that_does_not_look_so_far_is_refused(bench: Bench, policy_run: Path, random_lpips: None) -> None:
    ended = bench("--policy", policy_run, "--rows", "policy", "--horizon", 9)
    assert ended.code == 1
    assert "looks at most 8 actions ahead, not 9; give --horizon 8" in ended.err
