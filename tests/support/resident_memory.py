"""The resident memory of this process, as Linux counts it."""

from __future__ import annotations

from pathlib import Path

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")

RESET_PEAK = "5"  # written to clear_refs, it resets the peak of the resident memory

KNOWN = STATUS.exists() and CLEAR.exists()


def resident_now() -> int:
    """Bytes of resident memory."""
    return _status("VmRSS")


def peak_resident() -> int:
    """The most bytes since ``forget_peak``, else since the process began."""
    return _status("VmHWM")


def forget_peak() -> None:
    """Reset the peak of the resident memory."""
    CLEAR.write_text(RESET_PEAK)


def _status(key: str) -> int:
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return int(lines[key].split()[0]) * 1024
