#!/bin/sh
# Installs the Debian or Ubuntu packages of a group that are missing, when root or sudo allows it;
# else prints the one line that does and ends with status 1.
#   tools/system_packages.sh demo    Python's venv, C++ compiler, make
#   tools/system_packages.sh avr     AVR compiler, Arduino core, simulator, uploader
#   tools/system_packages.sh browser Chromium, where the system has it as a package
#   tools/system_packages.sh soak    clang with libFuzzer
set -u

here=$(dirname "$0")
missing=

# Asks for what a package brings, so that a tool from elsewhere (pyenv, /usr/local) counts too.
want_command() { # COMMAND PACKAGE
    command -v "$1" >/dev/null 2>&1 || missing="$missing $2"
}

want_package() { # PACKAGE FILE...: one of the files will do where there is no dpkg
    package=$1
    shift
    if command -v dpkg >/dev/null 2>&1; then
        [ "$(dpkg-query -W -f '${db:Status-Abbrev}' "$package" 2>/dev/null | cut -c1-2)" = ii ] && return
    else
        for file in "$@"; do
            [ -e "$file" ] && return
        done
    fi
    missing="$missing $package"
}

# Debian's python3, or the newest that Ubuntu offers beside an older python3; nothing where there is
# none: find_python.sh then says so.
python_packages() {
    default=$(apt-cache policy python3 2>/dev/null | sed -n 's/^ *Candidate: *\([0-9]*\.[0-9]*\).*/\1/p')
    case $default in
        3.[0-9] | 3.10)
            for version in 3.13 3.12 3.11; do
                if apt-cache show "python$version-venv" >/dev/null 2>&1; then
                    echo "python$version-venv"
                    return
                fi
            done
            ;;
        *)
            echo python3-venv
            ;;
    esac
}

find_missing() { # GROUP
    missing=
    case $1 in
        demo)
            want_command make make
            want_command g++ g++
            "$here/find_python.sh" >/dev/null 2>&1 || missing="$missing $(python_packages)"
            ;;
        avr)
            want_command avr-gcc gcc-avr
            want_command avrdude avrdude
            want_command simavr simavr
            want_command g++ g++
            want_package avr-libc /usr/lib/avr/include/avr/io.h
            want_package arduino-core-avr /usr/share/arduino/hardware/arduino/avr/boards.txt
            want_package libsimavr-dev /usr/include/simavr/sim_avr.h
            want_package libelf-dev /usr/include/libelf.h
            ;;
        browser)
            # The shell without windows is enough. Ubuntu has a snap behind an empty package alone;
            # the tests that need a browser skip there and say so.
            found=
            for name in chromium-headless-shell chromium google-chrome; do
                command -v "$name" >/dev/null 2>&1 && found=$name
            done
            for name in chromium-headless-shell chromium; do
                [ -z "$found" ] || break
                case $(apt-cache policy "$name" 2>/dev/null | sed -n 's/^ *Candidate: *//p') in
                    '' | '(none)' | *snap*) ;;
                    *) missing="$missing $name" found=$name ;;
                esac
            done
            ;;
        soak)
            want_command clang++ clang
            # Its libFuzzer is a package of its own where that is known; else in clang's.
            ls "$(clang++ -print-runtime-dir 2>/dev/null)"/libclang_rt.fuzzer* >/dev/null 2>&1 ||
                { apt-cache show libclang-rt-dev >/dev/null 2>&1 && missing="$missing libclang-rt-dev"; }
            ;;
        *)
            echo "usage: tools/system_packages.sh demo|avr|browser|soak" >&2
            exit 2
            ;;
    esac
    missing=${missing# }
}

find_missing "${1:-}"
[ -z "$missing" ] && exit 0

if ! command -v apt-get >/dev/null 2>&1; then
    echo "relpos: missing: $missing (Debian's names; install what your system calls them)" >&2
    exit 1
fi
if [ "$(id -u)" = 0 ]; then
    as_root=
elif sudo -n true 2>/dev/null; then
    as_root="sudo -n"
else
    echo "relpos: system packages are missing; this installs them:" >&2
    echo "  sudo apt-get update && sudo apt-get install -y --no-install-recommends $missing" >&2
    exit 1
fi

echo "relpos: installing system packages: $missing"
$as_root apt-get update -q || exit 1
# Which Python is on offer is known only now.
find_missing "$1"
# shellcheck disable=SC2086 # one word a package
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends $missing || exit 1
find_missing "$1"
if [ -n "$missing" ]; then
    echo "relpos: still missing after the installation: $missing" >&2
    exit 1
fi
