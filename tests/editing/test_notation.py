"""Edits are read as they are written, and what cannot be read is named."""

import pytest

from persist_cli.api.cells import Box
from persist_cli.api.scene_edits import Insert, Move, Paint, Remove
from persist_cli.editing.notation import WrittenEdit, make_edits, parse_box, parse_color, read_edits, write_edits
from persist_cli.errors import DataError

THINGS = {"table#1": Box((1.0, 0.0, 2.0), (2.0, 0.75, 3.0)), "box#1": Box((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))}


def made(option: str, *values: str, overwrite: bool = False):
    return make_edits([WrittenEdit(option, values)], THINGS, overwrite)[0]


def test_edits_are_made_in_the_order_in_which_they_are_written():
    written = [
        WrittenEdit("remove", ("table#1",)),
        WrittenEdit("insert", ("box", "1,_,2")),
        WrittenEdit("remove", ("box#1",)),
    ]
    assert [type(edit) for edit in make_edits(written, THINGS, False)] == [Remove, Insert, Remove]


def test_the_corners_of_a_box_come_in_any_order_and_may_be_negative():
    assert parse_box("-1,2.5,3:1,0,-3", None) == Box((-1.0, 0.0, -3.0), (1.0, 2.5, 3.0))


def test_a_height_that_is_left_open_is_none():
    assert made("insert", "table", "1.5,_,-2") == Insert(kind="table", at=(1.5, None, -2.0))


def test_colours_are_written_in_hexadecimal_or_by_name():
    assert parse_color("#ff8000") == (255, 128, 0)
    assert made("paint", "table#1", "orange") == Paint(low=(1, 0, 2), high=(2, 0.75, 3), color=(255, 165, 0))


def test_overwriting_is_asked_for_once_for_all_edits_of_a_command():
    assert made("move", "box#1", "1,0,0", overwrite=True) == Move(
        low=(0, 0, 0), high=(0.5, 0.5, 0.5), by=(1, 0, 0), overwrite=True
    )


def test_a_file_of_edits_holds_what_was_written(tmp_path):
    edits = [made("remove", "table#1"), made("insert", "box", "1,_,2"), made("paint", "box#1", "red")]
    write_edits(tmp_path / "edits.json", edits)
    assert read_edits(tmp_path / "edits.json") == edits
    assert make_edits([WrittenEdit("edits", (str(tmp_path / "edits.json"),))], None, False) == edits


@pytest.mark.parametrize(
    ("option", "values", "words"),
    [
        ("remove", ("tabel#1",), "--remove tabel#1: 'tabel#1' is no box x,y,z:x,y,z in metres, nor a thing: did you"),
        ("remove", ("1,2:3,4,5",), "'1,2' is not three numbers of metres, as in 1.5,0,-0.75"),
        ("remove", ("1,2,nan:3,4,5",), "'1,2,nan' is not three numbers"),
        ("paint", ("box#1", "oragne"), "'oragne' is no colour #rrggbb, nor the name of one; did you mean 'orange'?"),
        ("paint", ("box#1", "#12"), "for example #ff8000 or orange"),
        ("paint", ("box#1", "rgb(300,0,0)"), "'rgb(300,0,0)' is no colour #rrggbb"),
        ("move", ("box#1", "1,0"), "--move box#1 1,0: '1,0' is not three numbers"),
        ("insert", ("box", "1,_"), "is not three numbers"),
        ("edits", ("nowhere.json",), "nowhere.json: cannot be read (No such file or directory)"),
    ],
)
def test_what_cannot_be_read_is_named_in_one_line(option, values, words):
    with pytest.raises(DataError) as error:
        made(option, *values)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[{", "Invalid JSON"),
        ('{"edit": "remove"}', "Input should be a valid"),
        ('[{"edit": "remove", "low": [0, 0, 0], "high": [1, 1, 1]}, {"edit": "melt"}]', "edit 2: "),
        ('[{"edit": "remove", "low": [0, 0, 0]}]', "edit 1: high: Field required"),
        ('[{"edit": "paint", "low": [0, 0, 0], "high": [1, 1, 1], "color": [0, 0, 300]}]', "edit 1: color.2: "),
        ('[{"edit": "insert", "kind": "box", "at": [0, 0, 0], "size": [1, -1, 1]}]', "edit 1: size.1: "),
    ],
)
def test_a_damaged_file_of_edits_says_which_edit_is_wrong(tmp_path, text, words):
    (tmp_path / "edits.json").write_text(text)
    with pytest.raises(DataError) as error:
        read_edits(tmp_path / "edits.json")
    assert str(error.value).startswith(f"{tmp_path / 'edits.json'}: ")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_memory_without_classes_has_no_things_with_names():
    with pytest.raises(DataError, match="this memory has no things with names"):
        parse_box("table#1", None)


def test_edits_of_a_file_overwrite_where_the_command_says_so(tmp_path):
    edits = [made("remove", "table#1"), made("copy", "box#1", "1,0,0"), made("insert", "box", "1,_,2")]
    write_edits(tmp_path / "edits.json", edits)
    written = make_edits([WrittenEdit("edits", (str(tmp_path / "edits.json"),))], None, True)
    assert written[0] == edits[0]
    assert [edit.overwrite for edit in written[1:]] == [True, True]
