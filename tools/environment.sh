#!/bin/sh
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
# Makes a virtual environment with this package and its requirements, or brings one up to date.
#
# usage: tools/environment.sh VENV EXTRAS [CONSTRAINTS]
#   EXTRAS       of setup.py, comma-separated
#   CONSTRAINTS  a pip constraints file
#
# With ROS sourced, the extra "ros" is the system's rclpy instead of the wheels from PyPI.
# Does nothing when the stamp in VENV says that all this is installed already. What an
# interrupted run left behind is made afresh.
set -eu

venv=$1 extras=$2 constraints=${3:-}
cd "$(dirname "$0")/.."

say() { echo "$*" >&2; }

# Prints the real interpreter (never that of a virtual environment) behind a command if it is
# Python 3.11 or 3.12; a pyenv shim may be on PATH and yet not run.
python_behind() {
    "$1" -c '
import os, sys
sys.version_info[:2] in ((3, 11), (3, 12)) or sys.exit(1)
print(os.path.realpath(sys.executable if sys.prefix == sys.base_prefix else sys._base_executable))' 2>/dev/null
}

# Says what a command that was given as the Python is instead; the shim of a version that pyenv
# does not have active is on PATH and starts, but runs nothing.
why_not() {
    if ! command -v "$1" >/dev/null; then
        echo "PYTHON=$1 is not there."
    elif version=$("$1" -c 'import platform; print(platform.python_version())' 2>&1); then
        echo "PYTHON=$1 is Python $version, not 3.11 or 3.12."
    else
        echo "PYTHON=$1 does not run; it says: $(echo "$version" | head -n 1)"
    fi
}

# Sets python, and mode to "ros" where the ROS that is sourced is to be used.
find_python() {
    python= mode=wheels
    for command in ${PYTHON:-"$venv/bin/python" python3 python3.12 python3.11 /usr/bin/python3}; do
        found=$(python_behind "$command") || continue
        python=${python:-$found}
        if [ "$want_ros" = yes ] && "$found" -c 'import rclpy' 2>/dev/null; then
            python=$found mode=ros
            return
        fi
    done
    if [ -z "$python" ]; then
        [ -z "${PYTHON:-}" ] || say "$(why_not "$PYTHON")"
        [ -n "${PYTHON:-}" ] || say "There is no Python 3.11 or 3.12 on PATH."
        say "Install one, or say where it is: make PYTHON=/path/to/python3.12"
        exit 1
    fi
    if [ "$want_ros" = yes ] && [ -n "${ROS_DISTRO:-}" ]; then
        say "ROS $ROS_DISTRO is sourced, but its rclpy cannot be imported by Python 3.11 or 3.12;" \
            "source ROS 2 Jazzy instead, or use a terminal in which no ROS is sourced"
        exit 1
    fi
}

create() {
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        say "$python cannot make virtual environments; on Debian and Ubuntu:" \
            "sudo apt install python3-venv"
        exit 1
    fi
    rm -rf "$venv"
    if [ $mode = ros ]; then
        "$python" -m venv --system-site-packages "$venv"
    else
        "$python" -m venv "$venv"
    fi
    echo "$python $mode $PWD" > "$venv/.made-for"  # last: without it, it is made again
}

# Says whether the package and all extras are installed as they are asked for now.
up_to_date() {
    for part in package $(echo "$extras" | tr ',' ' '); do
        [ "$(cat "$venv/.installed-$part" 2>/dev/null)" = "$key" ] || return 1
    done
}

want_ros=no
case ",$extras," in *,ros,*) want_ros=yes ;; esac
find_python
[ $mode = wheels ] || extras=$(echo ",$extras," | sed 's/,ros,/,/; s/^,//; s/,$//')

key=$(cat package.xml setup.py setup.cfg tools/environment.sh ${constraints:+"$constraints"} | cksum)
[ "$(cat "$venv/.made-for" 2>/dev/null)" = "$python $mode $PWD" ] || create
[ ! -e "$venv/.interrupted" ] || create
! up_to_date || exit 0

what='numpy, scipy and readers of bags (80 MB)'
case ",$extras," in *,ros,*) what="ROS 2 (60 MB), $what" ;; esac
case ",$extras," in *,test,*) what="$what, what tests need (120 MB)" ;; esac
say "Installing into $venv from PyPI: $what; with a fast network this takes a minute or two ..."
touch "$venv/.interrupted"
if [ -t 2 ]; then quiet=; else quiet='--quiet --quiet'; fi  # pip shows a person its progress
# editable_mode: by a path, so that a script beside the clone finds the package and not its folder
# shellcheck disable=SC2086
"$venv/bin/python" -m pip install $quiet --disable-pip-version-check \
    ${constraints:+--constraint "$constraints"} \
    --config-settings editable_mode=compat --editable ".[$extras]"
for part in package $(echo "$extras" | tr ',' ' '); do
    echo "$key" > "$venv/.installed-$part"
done
rm "$venv/.interrupted"
