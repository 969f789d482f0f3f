"""What each row's memory gives for a clip: tokens, bytes, resolution, and whether it was made of depth."""

from __future__ import annotations

from persist_cli.evaluate.report.result_file import EvalResults, ReadsRecord
from persist_cli.evaluate.report.tables import UNDEFINED

READS_TITLE = "What a memory gives for a generated clip"

READS_HEADS = ("row", "tokens", "bytes", "resolution", "made of depth")


def read_rows(results: EvalResults) -> list[list[str]]:
    """The texts of each row of a model with a memory, in the order of ``READS_HEADS``; empty when there is none."""
    rows: dict[str, ReadsRecord] = {}
    for table in results.tables:
        for name, row in table.rows.items():
            if row.kind == "model" and row.reads is not None:
                rows.setdefault(name, row.reads)
    return [[name, *read_texts(reads)] for name, reads in rows.items()]


def read_texts(reads: ReadsRecord) -> list[str]:
    """Tokens, bytes, resolution and use of depth as texts."""
    size = UNDEFINED if reads.resolution is None else f"{reads.resolution * 100:.3g} cm at {reads.distance:g} m"
    return [_count(reads.tokens), _count(reads.bytes), size, "yes" if reads.reads_depth else "no"]


def reads_line(results: EvalResults) -> str:
    """One line with tokens, bytes and resolution of each row; empty when no row has a memory."""
    parts = [f"{name} {tokens} tokens, {size} bytes, {detail}" for name, tokens, size, detail, _ in read_rows(results)]
    return f"read from memory for a clip: {'; '.join(parts)}" if parts else ""


def _count(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:,.0f}"
