"""The code blocks of a Markdown page and the commands in them, and how one command is run in this process."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from accelerate.state import AcceleratorState

from persist_cli.cli.app import main

FENCE = re.compile(r"^(?P<indent> *)```(?P<language>[a-z]*|{[a-z]+})\n(?P<text>.*?)^(?P=indent)```$", re.M | re.S)
FILE_NAME = re.compile(r"(?:#!.*\n)?# (?P<name>[\w./-]+\.(?:py|toml|yaml|sh))\n")  # it says where a block belongs

COMMENT = re.compile(r"(^|\s)#.*")  # shlex would begin one within sample#0 too


@dataclass(frozen=True)
class Block:
    """A code block of a page.

    Args:
        line: number of its first line in the page.
        language: the word behind the fence, empty without one.
        text: what is between the fences, without their indentation.
    """

    line: int
    language: str
    text: str

    @property
    def file(self) -> str | None:
        """The file that a comment in the first line, or below a script's interpreter, names; ``None`` without one."""
        match = FILE_NAME.match(self.text)
        return None if match is None else match["name"]


@dataclass(frozen=True)
class ShownCommand:
    """A command of a ``console`` block, and the lines that are shown below it."""

    command: str
    lines: tuple[str, ...]


def read_blocks(page: Path) -> list[Block]:
    """All code blocks of a page, in order; directives of Sphinx are none."""
    text = page.read_text(encoding="utf-8")
    blocks = []
    for match in FENCE.finditer(text):
        if match["language"].startswith("{"):
            continue
        content = re.sub(f"^{match['indent']}", "", match["text"], flags=re.M)
        blocks.append(Block(text.count("\n", 0, match.start()) + 2, match["language"], content))
    return blocks


def commands(block: Block) -> list[str]:
    """The commands of a ``bash`` block, those of ``A && B`` apart; lines that end in a backslash are joined."""
    joined = re.sub(r"\\\n *", "", block.text)
    parts = (part.strip() for line in joined.splitlines() for part in COMMENT.sub("", line).split("&&"))
    return [part for part in parts if part]


def shown_commands(block: Block) -> Iterator[ShownCommand]:
    """The commands of a ``console`` block, which begin with a dollar sign, with what is shown of their output."""
    for part in re.split(r"^\$ ", block.text, flags=re.M)[1:]:
        command, _, output = part.partition("\n")
        yield ShownCommand(command, tuple(line for line in output.splitlines() if line.strip()))


def run_here(words: list[str]) -> tuple[int, str]:
    """Run ``persist`` with these arguments in this process; the exit code, and all that it printed."""
    AcceleratorState._reset_state(reset_partial_state=True)  # it fixes the precision of a process by the first run
    printed, code = io.StringIO(), 0
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main(words)
        except SystemExit as ended:
            code = int(ended.code or 0)
    return code, printed.getvalue()


def shows(output: str, line: str) -> bool:
    """Whether the output has a line like the shown one, in which … stands for anything."""
    pattern = ".*".join(map(re.escape, " ".join(line.split()).split("…")))
    return any(re.search(pattern, " ".join(text.split())) for text in output.splitlines())
