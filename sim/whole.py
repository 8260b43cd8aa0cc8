"""Texts written whole or not at all, so that a campaign that was killed can be continued."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8 beside its place and move it there, folder included; one that is there is replaced.

    Parameters
    ----------
    path : Path
        Its place.
    text : str
        What it holds.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".part-{path.name}")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
