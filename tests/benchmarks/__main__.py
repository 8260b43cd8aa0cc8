"""``make bench``: run the measurements and print their tables. ``python -m tests.benchmarks NAME ...`` runs some."""

from __future__ import annotations

import importlib
import pkgutil
import sys

import tests.benchmarks

names = sorted(module.name for module in pkgutil.iter_modules(tests.benchmarks.__path__) if module.name[0] != "_")
wanted = sys.argv[1:] or names
for name in wanted:
    if name not in names:
        sys.exit(f"no benchmark {name!r}; there are: {', '.join(names)}")
for name in wanted:
    importlib.import_module(f"tests.benchmarks.{name}").main()
