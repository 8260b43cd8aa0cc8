"""``python -m autotune``: the command line where the ``autotune`` script is not on the path."""

from autotune.entry import main

main()
