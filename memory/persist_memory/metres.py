"""Lengths in the settings of memories."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
