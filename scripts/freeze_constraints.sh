#!/usr/bin/env bash
# Rewrite constraints.txt from an environment: scripts/freeze_constraints.sh [environment folder]
# Run `make docs` there before, which installs the tools of the site.
# Only "name==version" lines are kept: no paths, no links, no local version suffix (torch's +cpu, +cu12 resolve nowhere
# else).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
env="${1:-${BEAGS_VENV:-.venv}}"
version="$("$env/bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
{
  echo "# Exact versions of every dependency, as tested with Python $version; written by scripts/freeze_constraints.sh."
  "$env/bin/python" -m pip --disable-pip-version-check freeze --all --exclude-editable |
    grep -E '^[A-Za-z0-9._-]+==' | grep -vE '^(pip|beags)==' | sed -E 's/\+[A-Za-z0-9.]+$//'
} >constraints.txt.new
mv constraints.txt.new constraints.txt
