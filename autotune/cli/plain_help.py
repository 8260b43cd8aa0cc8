"""What ``--help`` says of a call's parameters: a flag takes no value, and a number is a number."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperGroup

#: typer's words for the type of a value, and plain ones
_WORDS = {
    "<float range>": "<float>",
    "<int range>": "<int>",
    "<str>": "<text>",
    "<list[str]>": "<text>",
    "<float,float>": "<float> <float>",
}


def _plainly(params: list[Any], ctx: Any) -> list[Any]:
    """Give each option the words that its help shows for its value; a flag has none."""
    for param in params:
        if param.param_type_name == "option" and param.metavar is None:
            typed = getattr(param, "display_type", None)  # older versions have no such words
            param.metavar = "" if param.is_flag else _WORDS.get(typed(ctx)) if typed is not None else None
    return params


class PlainCommand(TyperCommand):
    """A command whose help reads as one would type it."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, with ``--help``."""
        return _plainly(super().get_params(ctx), ctx)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the line of usage: what must be given stands without the braces that nobody types."""
        pieces: list[str] = super().collect_usage_pieces(ctx)
        return [piece.replace("{", "").replace("}", "") for piece in pieces]


class PlainGroup(TyperGroup):
    """A group of commands whose help reads as one would type it."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, with ``--help``."""
        return _plainly(super().get_params(ctx), ctx)
