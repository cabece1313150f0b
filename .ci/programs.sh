#!/usr/bin/env bash
# Install a browser and LaTeX for the tests that use them, if possible; without them those tests skip.
set -u

has() { for name in "$@"; do command -v "$name" >/dev/null && return 0; done; return 1; }
as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }
install() {
    local log
    log=$(mktemp)
    if as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends "$@" >"$log" 2>&1 </dev/null; then
        echo "installed $*"
    else
        echo "$* cannot be installed ($(tail -n 1 "$log")); the tests that need it skip"
    fi
}

browsers=(chromium chromium-browser google-chrome google-chrome-stable chrome)  # as in tests/support/programs/chromium.py
missing=()
has "${browsers[@]}" || missing+=("chromium")
has pdflatex || missing+=("texlive-latex-base texlive-latex-recommended")
[ ${#missing[@]} = 0 ] || as_root apt-get update -qq >/dev/null 2>&1 </dev/null
for packages in "${missing[@]}"; do
    # shellcheck disable=SC2086 - one word per package
    install $packages
done
exit 0
