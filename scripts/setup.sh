#!/usr/bin/env bash
# Make the virtual environment and install the locked packages and this project into it.
#
#   scripts/setup.sh VENV STAMP LOCK
#
# LOCK is requirements.lock (what running needs) or requirements-dev.lock (what tests and the documentation need as
# well). Packages are installed by uv, or by pip where uv cannot be had. STAMP is written last, so its presence means a whole installation. PYTHON= names the interpreter to use;
# otherwise the usual names are tried, then the versions that pyenv keeps.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=$1
stamp=$2
lock=$3
unfinished=$venv/.installing
log=$venv/setup.log

fail() {
  printf 'setup: %s\n' "$1" >&2
  exit 1
}

# The locked set has wheels for these versions of Python.
supported='sys.version_info[:2] in ((3, 12), (3, 13))'

# Runs the candidate instead of looking for it: pyenv's shims exist for versions that are not active.
suits() { "$1" -c "import sys; sys.exit(not ($supported))" >/dev/null 2>&1; }
makes_venvs() { "$1" -c 'import ensurepip, venv' >/dev/null 2>&1; }

find_python() {
  local candidate without_venv=""
  if [[ -n ${PYTHON:-} ]]; then
    suits "$PYTHON" || fail "PYTHON=$PYTHON is not a Python 3.12 or 3.13; name one that is, or leave PYTHON out to search."
    makes_venvs "$PYTHON" || fail "PYTHON=$PYTHON has no venv module; install it (Debian, Ubuntu: apt install python3-venv)."
    echo "$PYTHON"
    return
  fi
  for candidate in python3.12 python3.13 python3 python \
    "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.13*/bin/python; do
    if suits "$candidate"; then
      if makes_venvs "$candidate"; then
        echo "$candidate"
        return
      fi
      without_venv=$candidate
    fi
  done
  if [[ -n $without_venv ]]; then
    fail "$without_venv has no venv module; install it (Debian, Ubuntu: apt install python3.12-venv) and run make again."
  fi
  fail "no Python 3.12 or 3.13 found; install one (apt install python3.12 python3.12-venv; brew install python@3.12; pyenv install 3.12), or name it: make PYTHON=/path/to/python3.12"
}

# pip's own output goes to the log; what is shown is one line per package, overwritten on a terminal.
show_progress() {
  local total=$1 terminal=0
  [[ -t 1 ]] && terminal=1
  awk -v total="$total" -v terminal="$terminal" '
    /^(Collecting|Requirement already satisfied)/ {
      n += 1; name = ($1 == "Collecting") ? $2 : $4; sub(/ .*/, "", name)
      if (terminal) { printf "\r\033[K  %3d of at most %d  %s", n, total, name; fflush() }
      else if (n % 20 == 0) { printf "  %d of at most %d packages\n", n, total; fflush() }
    }
    /^Installing collected packages/ {
      printf "%s  unpacking (a minute or two) ...\n", terminal ? "\r\033[K" : ""; fflush()
    }
    END { if (terminal) printf "\r\033[K" }'
}

pip() { "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@"; }

stop() { # stop WHO: the last words of the log, and the end
  tail -n 15 "$log" >&2
  fail "$1 could not install the packages (its last lines are above, all of them in $log); run the same command again to start over."
}

# uv itself comes through pip, at the version and with the hashes of the lock.
install_uv() {
  awk '/^[A-Za-z0-9]/ { uv = /^uv==/ } uv' "$lock" >"$venv/uv.lock"
  pip install --require-hashes --no-deps -r "$venv/uv.lock" >>"$log" 2>&1
}

# One line per download of 100 MiB and more; every package is in the log.
with_uv() {
  "$venv/bin/uv" --no-progress pip install --python "$venv/bin/python" "$@" 2>&1 | tee -a "$log" |
    awk '/^ *Downloading .*\((.*GiB|[0-9][0-9][0-9][.0-9]*MiB)\)/ || /^(Prepared|Installed) / { print "  " $0; fflush() }'
}

with_pip() {
  pip install --progress-bar off "$@" 2>&1 | tee -a "$log" | show_progress "$(grep -c '^[A-Za-z0-9]' "$lock")"
}

if [[ -e $unfinished ]] || ! suits "$venv/bin/python"; then
  python=$(find_python) # before anything is removed
  if [[ -e $unfinished ]]; then
    echo "setup: an earlier installation did not finish; starting over"
  elif [[ -e $venv ]]; then
    echo "setup: $venv is no working Python 3.12 or 3.13 environment; making it anew"
  fi
  echo "setup: making $venv with $("$python" --version) ($python)"
  rm -rf "$venv"
  mkdir -p "$venv"
  touch "$unfinished" # before anything else is in there: a kill from here on is noticed next time
  "$python" -m venv "$venv"
fi
rm -f "$venv"/.installed* # the other stamp as well: an installation that stops half-way spoils both
touch "$unfinished"
: >"$log"
# An environment made by uv has no pip.
"$venv/bin/python" -m pip --version >/dev/null 2>&1 || "$venv/bin/python" -m ensurepip >>"$log" 2>&1

echo "setup: installing the packages of $lock (about 3 GB to download the first time; log in $log)"
tool=with_uv
if ! install_uv; then
  echo "setup: uv could not be installed (see $log); using pip instead, which takes several minutes longer"
  tool=with_pip
elif ! with_uv --require-hashes -r "$lock"; then
  echo "setup: uv could not install the packages (see $log); trying pip instead, which takes several minutes longer"
  tool=with_pip
fi
if [[ $tool == with_pip ]]; then with_pip --require-hashes -r "$lock" || stop pip; fi
# setuptools, which builds the project, is in the lock: nothing is fetched here that the lock does not know.
"$tool" --no-deps --no-build-isolation -e . >/dev/null || stop "${tool#with_}"

rm -f "$unfinished"
touch "$stamp"
echo "setup: done"
