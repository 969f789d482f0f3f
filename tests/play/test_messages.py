import pytest

from persist_cli.errors import PersistError
from persist_cli.play import messages
from persist_cli.play.messages import FrameHeader, ImagePart, Pose, pack, read_message
from tests.support.play_pages import unpack


def test_a_message_of_the_page_is_read():
    assert read_message('{"type":"keys","held":["forward","left"]}') == messages.Keys(held=["forward", "left"])
    assert read_message('{"type":"jump","x":1,"y":-2.5}') == messages.Jump(x=1, y=-2.5)
    assert read_message('{"type":"settings","steps":2}').changes == {"steps": 2}


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("{", "Invalid JSON"),
        ("[]", "object"),
        ("[" * 3000, "Invalid JSON"),
        ('{"type":"shell"}', "'shell'"),
        ('{"type":"keys"}', "keys.held"),
        ('{"type":"keys","held":["../etc"]}', "keys.held.0"),
        ('{"type":"keys","held":["a","a","a","a","a","a","a","a","a"]}', "keys.held"),
        ('{"type":"jump","x":NaN,"y":0}', "jump.x"),
        ('{"type":"jump","x":true,"y":0}', "jump.x"),
        ('{"type":"settings","steps":0}', "settings.steps"),
        ('{"type":"settings","guidance":1e9}', "settings.guidance"),
        ('{"type":"settings","autoguidance":0.5}', "settings.autoguidance"),
        ('{"type":"record","on":"yes"}', "record.on"),
        ('{"type":"record","on":true,"folder":"/etc"}', "record.folder"),
        ('{"type":"ack","number":-1}', "ack.number"),
    ],
)
def test_a_wrong_message_is_refused_in_one_line_that_names_the_place(text, place):
    with pytest.raises(PersistError, match="cannot read what the page sent") as error:
        read_message(text)
    assert place in str(error.value)
    assert "\n" not in str(error.value)


def test_a_page_is_told_the_limits_of_autoguidance_where_the_model_has_a_guide():
    assert messages.limits(guided=True).pop("autoguidance") == (1, 10)
    assert list(messages.limits(guided=False)) == ["steps", "guidance", "seed"]


def test_a_message_that_is_too_long_is_not_even_parsed():
    with pytest.raises(PersistError, match="at most 4096 bytes"):
        read_message('{"type":"keys","held":[' + " " * 4096 + "]}")
    with pytest.raises(PersistError, match="at most 4096 bytes"):
        read_message("é" * 3000)


def test_a_frame_is_unpacked_as_it_was_packed():
    header = FrameHeader(
        number=7, action="forward", free=True, pose=Pose(x=1, y=2, degrees=90), milliseconds=12.5,
        images=[ImagePart(memory="voxel", bytes=3), ImagePart(memory="none", bytes=2)],
    )  # fmt: skip
    head, images = unpack(pack(header, [b"abc", b"de"]))
    assert head == header.model_dump(mode="json")
    assert images == [b"abc", b"de"]
