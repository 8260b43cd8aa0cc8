"""The one place where whatever a command ends with becomes one line and an exit status, what nobody foresaw included.

A command that fails on purpose raises one of the project's errors. Everything else arrives here: Ctrl-C at any moment,
errors of the operating system, memory that ran out, and defects, whose traceback goes to a file beside the output.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import sys
import tempfile
import time
import traceback
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn

import typer

from autotune.cli.plain_help import PlainCommand
from autotune.errors import AutotuneError, ExperimentStopped, InputError, OperatorStop, Unforeseen, UnforeseenAtRig
from autotune.outputs import unwritable
from autotune.text_files import printable, reason

#: parameters of the commands that name where results go, the most specific first
_PLACES = ("out", "resume")
#: most files that a message names
_MOST_NAMES = 6
_CLICK_EXCEPTION: type[Exception] = typer.BadParameter.__mro__[2]  # typer brings click under changing names


_RIG_IN_COMMAND: ContextVar[bool] = ContextVar("rig in command", default=False)


class GuardedCommand(PlainCommand):
    """A command whose every end is one of the project's errors, or click's own."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        began_s, before = time.time(), _RIG_IN_COMMAND.set(False)
        try:
            _require_finite(ctx)
            return super().invoke(ctx)
        except (AutotuneError, _CLICK_EXCEPTION, typer.Exit):
            raise
        except (KeyboardInterrupt, typer.Abort):
            _say_stopped(_place(ctx), began_s)
        except SystemError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):  # it came within a compiled function
                _say_stopped(_place(ctx), began_s)
            raise _unforeseen(error, ctx) from error
        except OSError as error:
            if error.errno == errno.EPIPE and error.filename is None:  # whoever read the output has gone
                without_stdout()
                raise typer.Exit(InputError.exit_status) from None
            raise _refusal(error) from None
        except (MemoryError, RecursionError) as error:
            raise _too_large(error) from None
        except Exception as error:
            raise _unforeseen(error, ctx) from error
        finally:
            _RIG_IN_COMMAND.reset(before)


def _require_finite(ctx: Any) -> None:
    """Refuse options that are no numbers: a comparison with NaN is always false, and no range would catch it."""
    for name, value in ctx.params.items():
        given = ctx.get_parameter_source(name)
        values = value if isinstance(value, list | tuple) else (value,)
        wrong = next((one for one in values if isinstance(one, float) and not math.isfinite(one)), None)
        if wrong is not None and given is not None and given.name == "COMMANDLINE":
            raise InputError(
                f"{wrong} is no finite number", where=f"--{name.replace('_', '-')}", remedy="give a number"
            )


def mark_rig_in_command() -> None:
    """Say that from here on the running command may have a rig in command: what fails then is a stop, not a refusal."""
    _RIG_IN_COMMAND.set(True)


def without_stdout() -> None:
    """Send what is left in standard output nowhere, so that the interpreter's own flush has nothing to say."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _text_of_error(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return printable(f"{type(error).__name__}: {text[0][:200]}" if text else type(error).__name__)


def _refusal(error: OSError) -> AutotuneError:
    if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EISDIR) and error.filename is not None:
        said = InputError(f"cannot be read ({reason(error)})", where=str(error.filename), remedy="check the path")
    else:
        said = unwritable(error, Path(str(error.filename)) if error.filename is not None else Path("a file"))
    if _RIG_IN_COMMAND.get():
        return ExperimentStopped(said.what, where=said.where, remedy=said.remedy)
    return said


def _unforeseen(error: Exception, ctx: Any) -> AutotuneError:
    kept = _keep_traceback(error, _place(ctx))
    kind = UnforeseenAtRig if _RIG_IN_COMMAND.get() else Unforeseen
    return kind(
        f"a defect of the tool: {_text_of_error(error)}",
        where=ctx.command_path,
        remedy=f"the traceback is in {kept}; please report it",
    )


def _too_large(error: BaseException) -> InputError:
    if isinstance(error, RecursionError):
        return InputError("the input is nested too deep", remedy="write it flat")
    return InputError("the memory is not enough for this input", remedy="give fewer rows or points, or more memory")


def _place(ctx: Any) -> Path | None:
    """Return where the command puts its results, None where it has no such place."""
    given = (ctx.params.get(name) for name in _PLACES)
    return next((place for place in given if isinstance(place, Path)), None)


def _say_stopped(place: Path | None, began_s: float) -> NoReturn:
    names = _since(place, began_s) if place is not None else []
    if not names:
        raise OperatorStop("stopped by the operator; nothing was written") from None
    shown = ", ".join(names[:_MOST_NAMES]) + (f" and {len(names) - _MOST_NAMES} more" * (len(names) > _MOST_NAMES))
    raise OperatorStop("stopped by the operator", where=str(place), remedy=f"kept so far: {shown}") from None


def _since(place: Path, began_s: float) -> list[str]:
    """Return the names of the files there that were written since the command began."""
    with contextlib.suppress(OSError):
        files = [file for file in place.rglob("*") if ".part-" not in str(file)] if place.is_dir() else [place]
        new = [file for file in files if file.is_file() and file.stat().st_mtime >= began_s - 0.02]
        return sorted(file.name if file == place else str(file.relative_to(place)) for file in new)
    return []


def _keep_traceback(error: BaseException, place: Path | None) -> Path | str:
    """Write the traceback beside the output, or where that cannot be written, and return its file."""
    text = "".join(traceback.format_exception(error))
    ordinary = place is not None and (place.is_dir() or place.is_file() or not place.exists())
    folders = [place if place.is_dir() else place.parent] if place is not None and ordinary else []
    for folder in (*folders, Path(), Path(tempfile.gettempdir())):
        file = folder / f"autotune-defect-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.txt"
        with contextlib.suppress(OSError, ValueError), file.open("x", encoding="utf-8", errors="replace") as handle:
            handle.write(text)
            return file
    return "no file, since none can be written"
