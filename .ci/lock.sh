#!/usr/bin/env bash
# Write the lock files anew from pyproject.toml: every package with its version and the hashes of its files, for every
# platform and Python from 3.11 on. No index is named in them: pip's own configuration says where packages come from.
# Usage: .ci/lock.sh UV, where UV is the uv command. Versions that still fit are kept; add --upgrade for the newest.
set -euo pipefail
cd "$(dirname "$0")/.."
uv=$1
shift
lock() {
  out=$1
  shift
  "$uv" pip compile "$@" --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
    --no-emit-index-url --no-emit-find-links --quiet -o ".ci/lock/$out.txt"
}
lock run pyproject.toml .ci/lock/build.in "$@"
lock test pyproject.toml .ci/lock/build.in --extra test "$@"
lock docs pyproject.toml .ci/lock/build.in --extra docs "$@"
lock tools .ci/lock/tools.in "$@"
