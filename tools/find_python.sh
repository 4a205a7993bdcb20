#!/bin/sh
# Prints the name of a Python 3.11 or newer that can make virtual environments; else says why not.
# RELPOS_PYTHON names another one to use.
set -u

seen=
[ -n "${RELPOS_PYTHON:-}" ] && set -- "$RELPOS_PYTHON" ||
    set -- python3 python3.13 python3.12 python3.11 python3.14
for name in "$@"; do
    version=$("$name" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue
    case $version in
        3.[0-9] | 3.10 | 2.*)
            seen="$seen $name ($version)"
            ;;
        *)
            if "$name" -c 'import ensurepip, venv' 2>/dev/null; then
                echo "$name"
                exit 0
            fi
            seen="$seen $name ($version, without venv)"
            ;;
    esac
done
echo "relpos needs Python 3.11 or newer with venv; found:${seen:- none}" >&2
exit 1
