"""``persist view``: a page on which memories, scenes, trajectories and rollouts are looked at and edited."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from persist_cli.errors import DataError, PersistError
from persist_cli.io.files import check_folder
from persist_cli.io.own_address import address_of, bind, is_loopback, leave, open_browser
from persist_cli.memorize.memory_file import load_paths
from persist_cli.output.console import busy, print_json, say, warn
from persist_cli.viewer.edit_session import EditSession, default_out
from persist_cli.viewer.imagine import Imaginer, ImagineSettings
from persist_cli.viewer.subject import TRUTH, Subject, describe, open_subject


@dataclass(frozen=True, kw_only=True)
class ViewPlan:
    """The options of ``persist view``; see its help.

    Args:
        source: a trajectory of a data set, a memory file, or the folder of a rollout.
        truth: true frames beside it.
        start: trajectory from whose frames the world model may begin.
        imagine: the world model.
        out: where an edited memory is saved; beside its file by default.
        most: the greatest number of blocks of a layer.
        seed: of what is imagined behind a removed thing.
    """

    source: str
    truth: str | None = None
    start: str | None = None
    imagine: ImagineSettings = field(default_factory=ImagineSettings)
    out: Path | None = None
    most: int = 40_000
    seed: int = 0


@dataclass(frozen=True)
class Address:
    """Where the page is.

    Args:
        host: the address that the server is bound to.
        port: its port, 0 for any free one.
        opens: whether a browser is opened.
    """

    host: str = "127.0.0.1"
    port: int = 8421
    opens: bool = True


def run_view(plan: ViewPlan, address: Address, export: Path | None, as_json: bool) -> None:
    """Show a subject until Ctrl-C, or write it as one HTML file.

    Args:
        plan: what is shown.
        address: where.
        export: HTML file to write instead.
        as_json: whether JSON is printed instead of text.

    Raises:
        PersistError: when viser is not installed, something is missing or damaged, or the port is taken.
    """
    check_viser()
    if export is not None:
        _check_export(export)
    else:
        check_address(address)
    with busy("loading what is shown"):
        subject = open_subject(plan.source, plan.truth, plan.start)
    if export is not None:
        write_page(plan, subject, export, as_json)
    else:
        serve_page(plan, subject, address, as_json)


def write_page(plan: ViewPlan, subject: Subject, path: Path, as_json: bool) -> None:
    """Write a subject as one HTML file, and say so."""
    from persist_cli.viewer.export import export_page
    from persist_cli.viewer.page_server import page_server
    from persist_cli.viewer.stage import Look, Stage

    with page_server(Address.host, 0) as server:
        stage = Stage(server, subject, Look(most=plan.most, layers=first_layers(subject)))
        moments = export_page(stage, path)
    _report(subject, {"file": str(path), "moments": moments}, as_json)


def serve_page(plan: ViewPlan, subject: Subject, address: Address, as_json: bool) -> None:
    """Show a subject on a page until Ctrl-C or SIGTERM."""
    from persist_cli.viewer.page import Page
    from persist_cli.viewer.page_server import page_server
    from persist_cli.viewer.stage import Look

    session, imaginer = make_session(plan, subject), make_imaginer(plan, subject)
    with page_server(address.host, address.port) as server:
        look = Look(most=plan.most, layers=first_layers(subject))
        page = Page(server, subject, look, session, imaginer)
        if page.imagine_panel is not None:
            server.on_client_connect(page.imagine_panel.load_ahead)
        url = address_of(address.host, server.get_port())
        try:
            _report(subject, {"address": url}, as_json)
            if session is not None and session.out.exists() and not as_json:
                say(f"Save replaces {session.out}; --out names another file")
            if address.opens and not as_json:
                threading.Thread(target=open_browser, args=(url,), daemon=True).start()
            while True:  # Ctrl-C ends no wait without a timeout on Windows
                time.sleep(3600.0)
        except KeyboardInterrupt:
            try:
                page.end()
                if session is not None:
                    say_unsaved(session)
            finally:  # of a second Ctrl-C, too: threads wait for the page's lock, and a model may be loading
                leave()


def say_unsaved(session: EditSession) -> None:
    """Say what is edited and not saved, if anything is, apart from what ``--json`` prints."""
    count = len(session.edits)
    if session.unsaved:
        warn(f"{count} edits are not saved in {session.out}" if count else f"{session.out} has edits that were undone")


def check_address(address: Address) -> None:
    """Raise ``PersistError`` when nothing can listen at an address; warn when others than this machine reach it."""
    with bind(address.host, address.port) as bound:
        if not is_loopback(bound):
            who = f"everybody who reaches {address.host}"
            warn(f"{who} can look and edit there; leave out --host to keep it to this machine")


def check_viser() -> None:
    """Raise ``PersistError`` when viser, which draws in the browser, is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise PersistError("view needs the package viser: pip install 'persist-cli[view]'") from error


def make_session(plan: ViewPlan, subject: Subject) -> EditSession | None:
    """Return the edits of the subject's memory, ``None`` without a memory.

    Raises:
        DataError: when the edited memory would be written over the one that is shown, or there is none to edit.
    """
    if subject.memory is None or subject.file is None:
        if plan.out is not None:
            raise DataError(f"--out {plan.out}: {plan.source} has no memory that could be edited; leave --out out")
        return None
    out = plan.out or default_out(subject.file)
    check_folder(out.parent)
    if out.is_dir() or out.suffix != ".safetensors":
        raise DataError(f"--out {out}: name a memory file to write, as in edited.safetensors")
    if out.resolve() == subject.file.resolve():
        raise DataError(f"--out {out}: is the memory that is shown; it stays as it is, name another file")
    return EditSession(subject.memory, load_paths(subject.file), out, plan.seed)


def make_imaginer(plan: ViewPlan, subject: Subject) -> Imaginer | None:
    """Return what imagines at a placed camera; ``None`` where no true frame of the scene is known.

    Raises:
        PersistError: when a model or adapter is named that is not there, or could not begin.
    """
    named = [f"--{name}" for name in ("checkpoint", "adapter") if getattr(plan.imagine, name) is not None]
    if subject.start is None:
        if named:
            raise DataError(f"{named[0]}: {plan.source} has no true frame to begin at; add --start DATA#trajectory")
        return None
    imaginer = Imaginer(plan.imagine, subject.start, subject.file)
    if named:
        imaginer.find()
    return imaginer


def first_layers(subject: Subject) -> set[str]:
    """Return the layers that are shown at first: the first one, and the truth."""
    return {name for number, name in enumerate(subject.layers) if number == 0 or name == TRUTH}


def _check_export(path: Path) -> None:
    check_folder(path.parent)
    if path.is_dir() or path.suffix.lower() not in (".html", ".htm"):
        raise DataError(f"--export {path}: name a page to write, as in view.html")


def _report(subject: Subject, place: dict[str, Any], as_json: bool) -> None:
    values = describe(subject) | place
    if as_json:
        print_json(values)
        sys.stdout.flush()
        return
    for line in subject.notices:
        say(line)
    blocks = ", ".join(f"{name} of {count:,} points" for name, count in values["blocks"].items())
    walks = ", ".join(f"{walk['name']} of {walk['frames']} frames" for walk in values["walks"])
    say(f"{subject.scene}: {'; '.join(filter(None, (blocks, walks))) or 'nothing in it'}")
    if "file" in place:
        say(f"page: {place['file']}, {Path(place['file']).stat().st_size / 1e6:.1f} MB")
        return
    if subject.memory is not None:
        say("to edit, hold Shift and draw a rectangle, or give a box")
    say(f"look at {place['address']} (Ctrl-C ends it)")
