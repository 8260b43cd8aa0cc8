"""``python -m autotune.cli``: the command line where the ``autotune`` script is not on the path."""

from autotune.cli import main

main()
