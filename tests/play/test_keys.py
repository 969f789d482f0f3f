"""Held keys mean actions: the longest combination first, else in turn; opposites cancel out."""

from __future__ import annotations

import pytest

from persist_cli.api.actions import Action, ActionVocabulary, walking_actions
from persist_cli.errors import DataError
from persist_cli.play.keys import held_actions

WALK = walking_actions()


@pytest.mark.parametrize(
    ("held", "actions"),
    [
        ("", ()),
        ("forward", ("forward",)),
        ("left forward", ("forward", "left")),
        ("forward backward", ()),
        ("forward backward left", ("left",)),
        ("stay", ("stay",)),
        ("stay left", ("left",)),
        ("pick_up forward", ("forward",)),
    ],
)
def test_held_keys_mean_actions_in_turn(held, actions):
    assert held_actions(held.split(), WALK) == actions


def test_an_action_that_does_both_is_taken_where_there_is_one():
    both = ActionVocabulary((*WALK.actions, Action("arc_left", forward=0.25, turn=15.0)))
    assert held_actions({"forward", "left"}, both) == ("arc_left",)
    assert held_actions({"forward", "right"}, both) == ("forward", "right")


def test_steps_come_before_turns_whatever_they_are_called():
    named = ActionVocabulary((Action("aside", turn=15.0), Action("walk", forward=0.25)))
    assert held_actions({"aside", "walk"}, named) == ("walk", "aside")


def test_an_unknown_action_is_named():
    with pytest.raises(DataError, match="unknown action 'jump'"):
        held_actions({"jump"}, WALK)
