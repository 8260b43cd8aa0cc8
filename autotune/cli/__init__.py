"""Command line: the only room that knows every other. Heavy imports wait until their command is called."""

from __future__ import annotations

import _thread
import contextlib
import errno
import os
import signal
import sys
import warnings
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from autotune.cli.guard import GuardedCommand, without_stdout
from autotune.cli.plain_help import PlainGroup
from autotune.errors import AutotuneError, InputError, OperatorStop
from autotune.interrupts import raise_interrupt
from autotune.text_files import printable

# typer brings click under a name that differs between its versions; its exported exception leads to the base classes
UsageError: type[Any] = typer.BadParameter.__mro__[1]
ClickException: type[Any] = typer.BadParameter.__mro__[2]

app = typer.Typer(
    name="autotune",
    cls=PlainGroup,
    help="Commission a control loop: measure its Bode points with a relay, design its controller, verify it.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # rich would take the units in brackets for styles, and show none
)
identify = typer.Typer(cls=PlainGroup, help="Identify the plant from a recording.", no_args_is_help=True)
app.add_typer(identify, name="identify")


def _say_version(asked: bool) -> None:
    if asked:
        from autotune.version import __version__

        typer.echo(f"relay-autotune {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    _version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_say_version, help="Say the version and leave.")
    ] = False,
) -> None:
    """Commission a control loop: measure its Bode points with a relay, design its controller, verify it."""


# Each room of commands registers itself on the two apps above; the order here is the order in --help.
from autotune.cli import (  # noqa: E402, F401, I001
    recordings,
    run,
    tune,
    deploy,
    live,
    frequency,
    delay,
    watch,
    closed_loop,
    design,
    references,
    paper,
    diagnose,
    model,
    investigate,
    batch,
    prove,
    rig,
    init,
    doctor,
)


#: what --help groups together, in the order of the work
TOUR = {
    "Before the first run": ("init", "doctor", "schema"),
    "At a rig": ("run", "deploy", "verify", "live", "dither", "investigate", "probe", "ports", "rig"),
    "From recordings to a controller": (
        "import",
        "tune",
        "identify",
        "reduce",
        "validate",
        "design",
        "rst",
        "margins",
        "reference",
        "controller",
    ),
    "In operation, and where model and rig differ": ("watch", "model", "simulate", "diagnose", "batch", "prove"),
    "What the papers print, computed anew": ("paper",),
}


def _arrange() -> None:
    """Put every command into its group; one that is in none stays at the head of the help."""
    order = [name for names in TOUR.values() for name in names]

    def place(name: str) -> int:
        return order.index(name) if name in order else -1

    def panel(name: str) -> str | None:
        return next((title for title, names in TOUR.items() if name in names), None)

    commands, groups = app.registered_commands, app.registered_groups
    named = {id(one): one.name or getattr(one.callback, "__name__", "") for one in commands}
    commands.sort(key=lambda one: place(named[id(one)]))
    for one in commands:
        one.rich_help_panel = panel(named[id(one)])
    for group in groups:
        group.rich_help_panel = panel(str(group.name))


_arrange()


def _guard() -> None:
    """Let every command end in one place."""
    groups = [group.typer_instance for group in app.registered_groups if group.typer_instance is not None]
    for one in (*app.registered_commands, *(one for group in groups for one in group.registered_commands)):
        one.cls = GuardedCommand


_guard()


def main() -> None:
    """Run the command line; whatever ends it is one line on stderr and its exit status."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, raise_interrupt)
    sys.unraisablehook = _unraisable
    # Threads wait for each other on small matrices longer than they work, the more the busier the machine is, and add
    # up in another order. The libraries read this when numpy is imported, which is later; what the user says stands.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # numpy's remarks are not for the user: results are checked for what they are
    try:
        status = app(standalone_mode=False)
        if status == OperatorStop.exit_status:  # typer's silent answer to Ctrl-C while it reads the call
            _leave("stopped by the operator; nothing was begun", OperatorStop.exit_status)
        sys.stdout.flush()
    except AutotuneError as error:
        _leave(printable(str(error)), error.exit_status)
    except ClickException as error:
        _leave(_usage(error), InputError.exit_status)
    except (typer.Abort, KeyboardInterrupt):
        _leave("stopped by the operator", OperatorStop.exit_status)
    except OSError as error:
        without_stdout()
        said = "" if error.errno == errno.EPIPE else f"the screen cannot be written ({error.strerror or error})"
        _leave(said, InputError.exit_status)
    except RecursionError:
        _leave("the input is nested too deep", InputError.exit_status)
    _hear_no_more()
    sys.exit(status or 0)


def _unraisable(unraisable: Any) -> None:
    """Raise a Ctrl-C again that came where Python can raise nothing, such as in a finaliser."""
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _thread.interrupt_main()
        return
    # the finaliser of an object that Ctrl-C kept from being made whole
    of_half_made = isinstance(unraisable.exc_value, AttributeError) and (
        getattr(unraisable.object, "__name__", "") == "__del__"
    )
    if not of_half_made:
        sys.__unraisablehook__(unraisable)


def _hear_no_more() -> None:
    """Ignore Ctrl-C from here on: what ends now has been said, and the interpreter's own end is no place for it.

    One that came while a text was executed (a dataclass that was made) would have ``python -m`` kill itself by a signal
    at the end, whatever became of the exception; the interpreter forgets it when it executes another text.
    """
    exec("", {})
    with contextlib.suppress(ValueError):  # a test that calls from another thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _leave(line: str, status: int) -> NoReturn:
    _hear_no_more()
    if line:
        console = Console(stderr=True, highlight=False, soft_wrap=True)
        with contextlib.suppress(OSError):
            console.print(f"autotune: {line}", markup=False)
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        without_stdout()
    sys.exit(status)


def _usage(error: Any) -> str:
    """Return what was wrong with the call in one line, and where its help is; nothing where the help was shown."""
    line = str(error.format_message())
    if not line or "\n" in line or not isinstance(error, UsageError):
        return line
    context = error.ctx
    return f"{line} See: {context.command_path if context else 'autotune'} --help"
