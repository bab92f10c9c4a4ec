#!/usr/bin/env bash
# Tries the studio's page in a real browser, as root on Debian: every way that a person may take.
#
#   studio/try.sh
#
# Installs Debian's chromium, runs all tests of the studio (20 browsers at once among them) and keeps the
# pictures of docs/studio.md. Ends with status 1 if one fails. The chromium package stays.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

make --no-print-directory .venv/.installed-dev
.ci/browser
command -v chromium >/dev/null || { echo "try.sh: no chromium: run 'sudo apt-get install chromium'" >&2; exit 1; }
export TANGRAM_TRY_STUDIO=1 TANGRAM_STUDIO_PICTURES=${TANGRAM_STUDIO_PICTURES:-$PWD/docs/images}
OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest -rP --durations=5 -m "check or not check" tests/studio \
    tests/cluster/test_studio.py tests/cluster/test_studio_browser.py |
    grep -vE '^(-+ Captured|_+ .* _+$)'
