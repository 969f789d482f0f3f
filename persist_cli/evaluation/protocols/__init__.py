"""Protocols: which clips an evaluation asks for, and what the memory knows by then."""

from persist_cli.evaluation.protocols.long import Long
from persist_cli.evaluation.protocols.protocol import Protocol, Selection
from persist_cli.evaluation.protocols.revisit import Revisit
from persist_cli.evaluation.protocols.there_and_back import ThereAndBack
from persist_cli.evaluation.protocols.unseen import Unseen

PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in (Revisit(), ThereAndBack(), Long(), Unseen())}

__all__ = ["PROTOCOLS", "Protocol", "Selection"]
