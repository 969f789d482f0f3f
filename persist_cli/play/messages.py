"""What the page and the server of ``persist play`` say to each other over one WebSocket, ``/walk``.

The page sends JSON text of at most ``MOST_BYTES``, an object with a ``type``::

    {"type": "keys", "held": ["forward"]}             whenever the set of held actions changes
    {"type": "ack", "number": 7}                      after the frame with this number was drawn
    {"type": "settings", "steps": 2}                  one or several of those of ``Settings``
    {"type": "reset", "seed": 3}                      the start again, with an empty way; the seed may be left out
    {"type": "undo"}                                  one frame back
    {"type": "home"}                                  to the start pose; what was remembered stays
    {"type": "jump", "x": 1.5, "y": -0.25}            to a place of the map's ground, in metres
    {"type": "record", "on": true}                    begin a recording; ``false`` ends and saves it
    {"type": "goal"}                                  the present picture becomes the goal
    {"type": "plan"}                                  the planner walks towards the goal
    {"type": "stop"}                                  the planner stops

The server sends JSON text: ``welcome`` first, ``state`` after each change that is no frame, ``notice``, ``error``,
``recorded``. Pictures come as binary messages: four bytes with the length of a JSON header (big-endian), the header,
and the images, one after another in the header's order, as PNG (see ``pack``). ``frame`` has one image
for each memory, ``map`` one.

The server has at most ``MOST_UNDRAWN`` frames on the way that were not acknowledged. It imagines none meanwhile, so a
slow page drops nothing and sees the newest keys' frame next. The first frame, and those after ``reset``, ``undo``,
``home`` and ``jump``, have no action and are acknowledged too.

A closed WebSocket has one of these codes: 1000 or 1001 at the end, 1008 for what the page must not do (too many
messages), 1009 for a message that is too long, 1011 for a fault of this session, 1013 where all sessions are taken.
An ``error`` with the reason comes before, where something can still be sent. 1011 without one means that the page was
not there for long.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from persist_cli.errors import PersistError

PROTOCOL: Final = 1
MOST_BYTES: Final = 4096  # of a message of the page
MOST_UNDRAWN: Final = 2  # frames sent and not yet acknowledged
LENGTH: Final = struct.Struct(">I")  # of the header of a binary message

MOST_STEPS: Final = 50
MOST_GUIDANCE: Final = 10.0
MOST_AUTOGUIDANCE: Final = 10.0
MOST_SEED: Final = 2**31 - 1

ActionName = Annotated[str, Field(pattern=r"^[a-z_]{1,32}$")]
Metres = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Steps = Annotated[int, Field(ge=1, le=MOST_STEPS)]
Guidance = Annotated[float, Field(allow_inf_nan=False, ge=0, le=MOST_GUIDANCE)]
Autoguidance = Annotated[float, Field(allow_inf_nan=False, ge=1, le=MOST_AUTOGUIDANCE)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]


class FromPage(BaseModel):
    """A message of the page: no other keys, and no value of another type."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Keys(FromPage):
    """The set of held actions has changed."""

    type: Literal["keys"] = "keys"
    held: Annotated[list[ActionName], Field(max_length=8)]


class Ack(FromPage):
    """A frame was drawn."""

    type: Literal["ack"] = "ack"
    number: Annotated[int, Field(ge=0, le=MOST_SEED)]


class ChangeSettings(FromPage):
    """Other settings from the next imagined clip on; those that are ``None`` stay."""

    type: Literal["settings"] = "settings"
    steps: Steps | None = None
    guidance: Guidance | None = None
    autoguidance: Autoguidance | None = None
    seed: Seed | None = None
    ahead: bool | None = None

    @property
    def changes(self) -> dict[str, Any]:
        """The settings that were named, and their values."""
        return self.model_dump(exclude={"type"}, exclude_none=True)


class Reset(FromPage):
    """Begin again at the start, with another seed if there is one."""

    type: Literal["reset"] = "reset"
    seed: Seed | None = None


class Undo(FromPage):
    """Go one frame back."""

    type: Literal["undo"] = "undo"


class Home(FromPage):
    """Stand at the start again without forgetting anything."""

    type: Literal["home"] = "home"


class Jump(FromPage):
    """Stand at another place of the ground, in metres of the map, with the same heading."""

    type: Literal["jump"] = "jump"
    x: Metres
    y: Metres


class Record(FromPage):
    """Begin a recording, or end and save it."""

    type: Literal["record"] = "record"
    on: bool


class Goal(FromPage):
    """Take the present picture as the goal."""

    type: Literal["goal"] = "goal"


class Plan(FromPage):
    """Let the planner walk towards the goal."""

    type: Literal["plan"] = "plan"


class Stop(FromPage):
    """Let the planner stop."""

    type: Literal["stop"] = "stop"


Command = ChangeSettings | Reset | Undo | Home | Jump | Record | Goal | Plan | Stop
PageMessage = Keys | Ack | Command

PAGE_MESSAGE: Final[TypeAdapter[PageMessage]] = TypeAdapter(Annotated[PageMessage, Field(discriminator="type")])


def read_message(text: str) -> PageMessage:
    """Return a message of the page.

    Raises:
        PersistError: when it is too long, no JSON, of an unknown type, or has a wrong key or value.
    """
    if len(text) > MOST_BYTES or len(text.encode(errors="replace")) > MOST_BYTES:
        raise PersistError(f"a message has at most {MOST_BYTES} bytes; send less")
    try:
        return PAGE_MESSAGE.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "message"
        raise PersistError(f"cannot read what the page sent: {place}: {first['msg']}; reload the page") from error


class ToPage(BaseModel):
    """A message of the server."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def to_json(self) -> str:
        """Return it as JSON text."""
        return self.model_dump_json()


class ActionKeys(ToPage):
    """An action that the page may hold.

    Args:
        name: of the vocabulary.
        effect: in words, as in ``0.25 m ahead``.
        keys: values of ``KeyboardEvent.code``, as in ``KeyW``; none where it has no key by default.
    """

    name: str
    effect: str
    keys: list[str]


class Settings(ToPage):
    """The settings as they are now; ``ahead``: whether likely next actions are imagined while no key is held."""

    steps: int
    guidance: float
    autoguidance: float
    seed: int
    ahead: bool


class Welcome(ToPage):
    """The first message: what is walked in, and with which actions.

    Args:
        protocol: version of these messages.
        model: name of the checkpoint.
        memories: names, in the order of each frame's images.
        actions: those that may be held.
        image: width and height of each image in pixels.
        settings: as they are at the start.
        limits: least and most of the settings that are numbers; ``autoguidance`` where the model has a guide.
    """

    type: Literal["welcome"] = "welcome"
    protocol: int = PROTOCOL
    model: str
    memories: list[str]
    actions: list[ActionKeys]
    image: tuple[int, int]
    settings: Settings
    limits: dict[str, tuple[float, float]]


def limits(guided: bool) -> dict[str, tuple[float, float]]:
    """Return the least and the most of the settings that are numbers; ``guided``: whether the model has a guide."""
    away = {"autoguidance": (1.0, MOST_AUTOGUIDANCE)} if guided else {}
    return {"steps": (1, MOST_STEPS), "guidance": (0, MOST_GUIDANCE), **away, "seed": (0, MOST_SEED)}


class State(ToPage):
    """What has changed beside the picture.

    Args:
        settings: as they are now.
        recording: whether frames are recorded.
        goal: whether there is a goal.
        planning: whether the planner walks.
    """

    type: Literal["state"] = "state"
    settings: Settings
    recording: bool = False
    goal: bool = False
    planning: bool = False


class Notice(ToPage):
    """A line that is no error, as ``the goal is reached``."""

    type: Literal["notice"] = "notice"
    text: str


class Error(ToPage):
    """One line that says what is wrong; ``ended``: whether the session ends with it."""

    type: Literal["error"] = "error"
    text: str
    ended: bool = False


class Recorded(ToPage):
    """A recording was saved; the addresses are those of this server and live as long as the session.

    Args:
        frames: number of frames, the first one included.
        video: address of the MP4.
        trajectory: address of a ZIP of the data set with this trajectory, as ``rollout --follow`` and ``eval`` read it.
        folder: where it stays on this machine, ``None`` where it goes with the session.
    """

    type: Literal["recorded"] = "recorded"
    frames: int
    video: str
    trajectory: str
    folder: str | None = None


class Pose(ToPage):
    """A place on the ground in metres of the map, and the heading in degrees."""

    x: float
    y: float
    degrees: float


class ImagePart(ToPage):
    """One image of a binary message: of which memory, and its length in bytes."""

    memory: str
    bytes: int


class FrameHeader(ToPage):
    """The header of a frame.

    Args:
        number: counts up by one from frame to frame of a session.
        action: that led here; ``None`` where none did.
        free: whether its way was free; a blocked action shows the frame before it once more.
        pose: where the agent stands.
        milliseconds: that the server took for this frame.
        images: one for each memory.
    """

    type: Literal["frame"] = "frame"
    number: int
    action: str | None
    free: bool
    pose: Pose
    milliseconds: float
    images: list[ImagePart]


class MapHeader(ToPage):
    """The header of a map seen from above; ``extent`` is x0, y0, x1, y1: metres at its left, bottom, right, top."""

    type: Literal["map"] = "map"
    extent: tuple[float, float, float, float]
    images: list[ImagePart]


def pack(header: FrameHeader | MapHeader, images: Sequence[bytes]) -> bytes:
    """Return a binary message of the images that the header names."""
    assert [part.bytes for part in header.images] == [len(image) for image in images]
    head = header.to_json().encode()
    return b"".join((LENGTH.pack(len(head)), head, *images))
