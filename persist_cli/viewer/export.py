"""One HTML file that shows a subject without a server, to be sent to somebody."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from persist_cli.io.files import write_text
from persist_cli.viewer.stage import Stage

FRAMES_A_SECOND: Final = 6.0
MOST_MOMENTS: Final = 120  # of the player in the page; of a longer walk evenly chosen ones
OFFLINE: Final = (
    "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'self' data: blob: 'unsafe-inline' "
    "'unsafe-eval' 'wasm-unsafe-eval'; connect-src data: blob:\">"
)


def export_page(stage: Stage, path: Path) -> int:
    """Write what a stage draws as one HTML file, with a player where there is a walk, whole or not at all.

    The file holds viser's page and all data, and asks no server for anything. What needs a program behind the page is
    not in it: editing, reading, imagining, and the detail that comes with nearness.

    Args:
        stage: what is drawn.
        path: the HTML file.

    Returns:
        The number of moments that its player shows.

    Raises:
        OSError: when it cannot be written.
    """
    length = max((len(walk) for walk in stage.subject.walks), default=0)
    step = max(1, -(-length // MOST_MOMENTS))
    if length:
        stage.draw_time(0)
    recording = stage.server.get_scene_serializer()
    moments = range(0, length, step) if length > 1 else range(0)
    for frame in moments:
        stage.draw_time(frame)
        recording.insert_sleep(1 / FRAMES_A_SECOND)
    page = recording.as_html().replace("<head>", f"<head>{OFFLINE}", 1)
    write_text(path, page.replace("<title>Viser</title>", "<title>persist view</title>", 1))
    return len(moments)
