"""A range is one value or two ends; what is drawn lies between them."""

from __future__ import annotations

import numpy as np
import pytest

from persist_cli.errors import DataError
from persist_cli.simulators.ranges import Range


def test_one_number_is_a_fixed_value_that_takes_no_random_number() -> None:
    random = np.random.default_rng(0)
    assert Range.parse("--step", "0.25").draw(random) == 0.25
    assert random.random() == np.random.default_rng(0).random()


def test_what_is_drawn_lies_between_the_ends() -> None:
    random, pitch = np.random.default_rng(0), Range.parse("--pitch", "-25:10")
    drawn = [pitch.draw(random) for _ in range(200)]
    assert -25 <= min(drawn) < -15
    assert 5 < max(drawn) <= 10


@pytest.mark.parametrize("text", ["", "10:5", "1:2:3", "nan", "5-20", "a:b"])
def test_anything_else_is_refused_by_the_option_and_its_text(text: str) -> None:
    with pytest.raises(DataError, match=f"--fov '{text}': write one number or LOW:HIGH"):
        Range.parse("--fov", text)
